/** Logic of the administration page (SPEC 1.16 and 3). */
import { sentence } from '../format'
import type { Asked } from './realm'
import type { Enrolment, Level, RealmGroup, RealmRight, RealmRobot, RealmUser } from './types'
import { Refusal } from './request'

/** Prefix of a group's name where a user's name is possible too. */
export const GROUP_MARK = '@'

export const LEVELS: [Level, string][] = [
  ['viewer', 'receives the data of the robot, and may stop it'],
  ['operator', 'may also drive it, call its services and record'],
  ['owner', 'may also inhibit topics, and take over control'],
]

/** Pattern of the relay for a search text: the text may occur anywhere in a name, unless it contains wildcards.
 *
 * @returns empty for all
 */
export function wanted(typed: string): string {
  const text = typed.trim().toLowerCase()
  if (text === '') return ''
  return /[*?[]/.test(text) ? text : `*${text}*`
}

/** Filter of a list of rights. */
export interface RightsFilter {
  robot: string
  /** Whether `robot` is a complete name. */
  exact: boolean
  who: string
}

/** Query for rights, which are named by robot and holder. For a known user it includes the rights of their groups. */
export function wantedRights({ robot, exact, who }: RightsFilter, { users }: Directory): Asked {
  const person = users.find(({ user }) => user === who.trim().toLowerCase())?.user
  const holder = person === undefined ? wantedHolder(who) : ''
  const machine = exact ? '' : wanted(robot)
  return {
    ...(exact ? { robot } : {}),
    ...(person === undefined ? {} : { user: person }),
    ...(machine === '' && holder === '' ? {} : { name: `${machine || '*'}/${holder || '*'}` }),
  }
}

function wantedHolder(who: string): string {
  const pattern = wanted(who)
  return pattern.startsWith(`*${GROUP_MARK}`) ? pattern.slice(1) : pattern
}

/** Patterns as text, one per line. */
export function patternsOf(text: string): string[] {
  return [...new Set(text.split('\n').map((line) => line.trim()).filter(Boolean))]
}

export interface OfRobot {
  robot: string
  rights: RealmRight[]
}

const RANK: Record<Level, number> = { owner: 0, operator: 1, viewer: 2 }

/** Rights by robot, in the order of the list; for each robot the highest level first. */
export function byRobot(rights: readonly RealmRight[]): OfRobot[] {
  const all = new Map<string, RealmRight[]>()
  for (const right of rights) all.set(right.robot, [...(all.get(right.robot) ?? []), right])
  return [...all].map(([robot, own]) => ({
    robot,
    rights: own.sort((a, b) => RANK[a.level] - RANK[b.level] || a.holder.localeCompare(b.holder)),
  }))
}

/** Robots without any right. */
export function without(robots: readonly RealmRobot[], rights: readonly RealmRight[]): string[] {
  const some = new Set(rights.map(({ robot }) => robot))
  return robots.map(({ robot }) => robot).filter((robot) => !some.has(robot))
}

/** Users and groups to choose from. */
export interface Directory {
  users: RealmUser[]
  groups: RealmGroup[]
}

export interface Choice {
  /** The name of the holder as in a right. */
  holder: string
  words: string
}

const CHOICES = 50

/** Users and groups whose names contain the text; those that begin with it come first. */
export function choices({ users, groups }: Directory, typed: string): Choice[] {
  const all = [
    ...users.map(({ user, admin, disabled }) => ({ holder: user, words: disabled ? 'disabled' : admin ? 'administrator' : '' })),
    ...groups.map(({ group, members }) => ({ holder: GROUP_MARK + group, words: `group, ${counted(members.length, 'member', 'members')}` })),
  ]
  const text = typed.trim().toLowerCase()
  const bare = (holder: string) => (text.startsWith(GROUP_MARK) ? holder : holder.replace(/^@/, ''))
  const begins = ({ holder }: Choice) => Number(!bare(holder).startsWith(text))
  return all
    .filter(({ holder }) => holder.includes(text))
    .sort((a, b) => begins(a) - begins(b))
    .slice(0, CHOICES)
}

/** Members of a group that holds a right; null for a user and for an unknown group. */
export function membersOf({ groups }: Directory, holder: string): string[] | null {
  if (!holder.startsWith(GROUP_MARK)) return null
  return groups.find(({ group }) => GROUP_MARK + group === holder)?.members ?? null
}

/** Administrators, who need no rights: they own every robot. */
export function administrators({ users }: Directory): string[] {
  return users.filter(({ admin, disabled }) => admin && !disabled).map(({ user }) => user)
}

export function counted(count: number, one: string, many: string): string {
  return `${count} ${count === 1 ? one : many}`
}

/** Whether two rights allow the same. */
export function alike(one: RealmRight, other: RealmRight): boolean {
  const all = ({ level, allow, deny }: RealmRight) => JSON.stringify([level, allow, deny])
  return all(one) === all(other)
}

/** A right in one line, without its holder. */
export function rightWords({ level, allow, deny }: RealmRight): string {
  const more = [
    ...(allow.length > 0 ? [`${allow.join(', ')} allowed`] : []),
    ...(deny.length > 0 ? [`${deny.join(', ')} denied`] : []),
  ]
  return [level, ...more].join('; ')
}

const DEFAULT_REALM = 'default'
const STATE = '/var/lib/switchboard-robot/state'

/** Command that starts an enrolled robot. */
export const RUN_COMMAND = `switchboard-robot run --state ${STATE}`

/** Command that enrols a robot. It asks for the code, because all users of the machine could see an argument. */
export function enrolCommand({ robot, robots_port }: Enrolment, realm: string, page: Pick<Location, 'hostname' | 'protocol'>): string {
  const full = realm === DEFAULT_REALM ? robot : `${robot}@${realm}`
  const tls = page.protocol === 'https:' ? ' --tls' : ''
  return (
    `switchboard-robot enroll --relay ${page.hostname}:${robots_port}${tls} --robot ${full} --code - ` +
    `--state ${STATE}`
  )
}

/** For how long a code is still valid, in words; empty when it has expired.
 *
 * @param until Unix seconds
 */
export function goodFor(until: number, now: number): string {
  const left = until - now
  if (left <= 0) return ''
  return left < 60 ? 'less than a minute' : counted(Math.ceil(left / 60), 'minute', 'minutes')
}

/** A code with the time of its expiry, Unix seconds. */
export interface Code extends Enrolment {
  until: number
}

export function dated(enrolment: Enrolment, now: number): Code {
  return { ...enrolment, until: now + enrolment.expires_in }
}

/** Why an action failed, and when it may be tried again. */
export function why(error: unknown): string {
  const words = sentence(error instanceof Error ? error.message : String(error))
  const wait = error instanceof Refusal ? error.retryAfter : null
  return wait === null ? words : `${words} Wait ${counted(Math.ceil(wait), 'second', 'seconds')}.`
}
