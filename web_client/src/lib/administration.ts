/** What the page of a realm makes of what the relay tells (protocol/SPEC.md 1.16 and 3). */
import { Refusal } from './api'
import { sentence } from './format'
import type { Asked, Enrolment, RealmGroup, RealmRight, RealmRobot, RealmUser } from './realm'
import type { Level } from './types'

/** What stands before the name of a group where a user could be meant. */
export const GROUP_MARK = '@'

export const LEVELS: [Level, string][] = [
  ['viewer', 'sees and hears what the robot sends, and may stop it'],
  ['operator', 'also drives it, calls its services and records'],
  ['owner', 'also silences topics, and overrides who drives'],
]

/** What a name has to look like, as a pattern of the relay: what is typed stands anywhere in it, unless it has wildcards.
 *
 * @returns empty for all
 */
export function wanted(typed: string): string {
  const text = typed.trim().toLowerCase()
  if (text === '') return ''
  return /[*?[]/.test(text) ? text : `*${text}*`
}

/** Which rights are meant. */
export interface RightsFilter {
  robot: string
  /** Whether that is all of the robot's name. */
  exact: boolean
  who: string
}

/** What is asked for of rights, whose names are a robot and a holder: all that somebody known has, also by his groups. */
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

/** Patterns as they are typed, one a line. */
export function patternsOf(text: string): string[] {
  return [...new Set(text.split('\n').map((line) => line.trim()).filter(Boolean))]
}

export interface OfRobot {
  robot: string
  rights: RealmRight[]
}

const RANK: Record<Level, number> = { owner: 0, operator: 1, viewer: 2 }

/** Rights by robot, in the order in which they come; of each robot those that go furthest first. */
export function byRobot(rights: readonly RealmRight[]): OfRobot[] {
  const all = new Map<string, RealmRight[]>()
  for (const right of rights) all.set(right.robot, [...(all.get(right.robot) ?? []), right])
  return [...all].map(([robot, own]) => ({
    robot,
    rights: own.sort((a, b) => RANK[a.level] - RANK[b.level] || a.holder.localeCompare(b.holder)),
  }))
}

/** Robots of a list on which there is no right at all. */
export function without(robots: readonly RealmRobot[], rights: readonly RealmRight[]): string[] {
  const some = new Set(rights.map(({ robot }) => robot))
  return robots.map(({ robot }) => robot).filter((robot) => !some.has(robot))
}

/** Who there is to choose from. */
export interface Directory {
  users: RealmUser[]
  groups: RealmGroup[]
}

export interface Choice {
  /** As a right names it. */
  holder: string
  words: string
}

const CHOICES = 50

/** Users and groups whose name has what is typed in it; those that begin with it come first. */
export function choices({ users, groups }: Directory, typed: string): Choice[] {
  const all = [
    ...users.map(({ user, admin, disabled }) => ({ holder: user, words: disabled ? 'disabled' : admin ? 'administrator' : '' })),
    ...groups.map(({ group, members }) => ({ holder: GROUP_MARK + group, words: `group, ${counted(members.length, 'person', 'people')}` })),
  ]
  const text = typed.trim().toLowerCase()
  const bare = (holder: string) => (text.startsWith(GROUP_MARK) ? holder : holder.replace(/^@/, ''))
  const begins = ({ holder }: Choice) => Number(!bare(holder).startsWith(text))
  return all
    .filter(({ holder }) => holder.includes(text))
    .sort((a, b) => begins(a) - begins(b))
    .slice(0, CHOICES)
}

/** Who is in a group that holds a right; null for a user, and for a group that is not known. */
export function membersOf({ groups }: Directory, holder: string): string[] | null {
  if (!holder.startsWith(GROUP_MARK)) return null
  return groups.find(({ group }) => GROUP_MARK + group === holder)?.members ?? null
}

/** Those who may do everything on every robot without a right. */
export function administrators({ users }: Directory): string[] {
  return users.filter(({ admin, disabled }) => admin && !disabled).map(({ user }) => user)
}

export function counted(count: number, one: string, many: string): string {
  return `${count} ${count === 1 ? one : many}`
}

/** Whether two rights let their holder do the same. */
export function alike(one: RealmRight, other: RealmRight): boolean {
  const all = ({ level, allow, deny }: RealmRight) => JSON.stringify([level, allow, deny])
  return all(one) === all(other)
}

/** A right in a line: who has it is said before it. */
export function rightWords({ level, allow, deny }: RealmRight): string {
  const more = [
    ...(allow.length > 0 ? [`${allow.join(', ')} allowed`] : []),
    ...(deny.length > 0 ? [`${deny.join(', ')} denied`] : []),
  ]
  return [level, ...more].join('; ')
}

const DEFAULT_REALM = 'default'
const STATE = '/var/lib/switchboard-robot/state'

/** What brings a robot online once it has enrolled. */
export const RUN_COMMAND = `switchboard-robot run --state ${STATE}`

/** What enrols a robot, run on it. The code is typed in: as an argument all users of the machine could see it. */
export function enrolCommand({ robot, robots_port }: Enrolment, realm: string, page: Pick<Location, 'hostname' | 'protocol'>): string {
  const full = realm === DEFAULT_REALM ? robot : `${robot}@${realm}`
  const tls = page.protocol === 'https:' ? ' --tls' : ''
  return (
    `switchboard-robot enroll --relay ${page.hostname}:${robots_port}${tls} --robot ${full} --code - ` +
    `--state ${STATE}`
  )
}

/** How long a code is still good, in words; empty when it is no more.
 *
 * @param until Unix seconds
 */
export function goodFor(until: number, now: number): string {
  const left = until - now
  if (left <= 0) return ''
  return left < 60 ? 'less than a minute' : counted(Math.ceil(left / 60), 'minute', 'minutes')
}

/** A code with the moment from which it is good no more, Unix seconds. */
export interface Code extends Enrolment {
  until: number
}

export function dated(told: Enrolment, now: number): Code {
  return { ...told, until: now + told.expires_in }
}

/** Why something was not done, and when it may be tried again. */
export function why(error: unknown): string {
  const words = sentence(error instanceof Error ? error.message : String(error))
  const wait = error instanceof Refusal ? error.retryAfter : null
  return wait === null ? words : `${words} Wait ${counted(Math.ceil(wait), 'second', 'seconds')}.`
}
