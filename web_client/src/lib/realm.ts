/** An administrator's own realm over HTTP (protocol/SPEC.md 1.16). Times in Unix seconds. */
import { Refusal, request } from './api'
import type { Level } from './types'

export interface RealmAbout {
  realm: string
  users: number
  groups: number
  robots: number
}

export interface RealmUser {
  user: string
  admin: boolean
  disabled: boolean
  /** Whether there is one. */
  password: boolean
  /** Whether it is that of an account in another realm. */
  guest: boolean
  groups: string[]
}

export interface RealmGroup {
  group: string
  members: string[]
}

export interface RealmRobot {
  robot: string
  description: string
  /** How many are live. */
  keys: number
  /** Whether it is another realm's, and shared with this one. */
  guest: boolean
}

/** What a robot enrols with; told once. */
export interface Enrolment {
  robot: string
  enrolment_code: string
  /** For how many seconds the code is good. */
  expires_in: number
  /** The port of the relay at which robots dial. */
  robots_port: number
}

export interface RealmKey {
  fingerprint: string
  agent: string
  created: number
  retired: number | null
}

export interface RealmRight {
  /** A user, or `@` and a group. */
  holder: string
  robot: string
  level: Level
  allow: string[]
  deny: string[]
}

export interface RealmToken {
  id: string
  kind: 'access' | 'session' | 'login'
  label: string
  created: number
  expires: number | null
  scope: string | null
}

/** A part of a list, in the order of names; `next` asks for the part after it, and is empty where there is none. */
export interface Part<T> {
  items: T[]
  next: string
}

/** What is asked of a list: `name` is a pattern with wildcards. */
export type Asked = Partial<Record<'name' | 'after' | 'robot' | 'user', string>> & { limit?: number }

/** The relay gives no more at a time. */
export const AT_ONCE = 1000

const HERE = '/api/v1/realm'

function path(...names: string[]): string {
  // The mark of a group stays as it is.
  return [HERE, ...names.map((name) => encodeURIComponent(name).replace(/^%40/, '@'))].join('/')
}

async function told<T>(method: string, at: string, body?: unknown, headers: Record<string, string> = {}): Promise<T> {
  return (await (await request(method, at, body, { headers })).json()) as T
}

/** What was to be changed is not as it was shown: somebody else was there meanwhile, and nothing was done. */
export class Overtaken extends Error {
  constructor(
    /** Whether it is there no more. */
    readonly gone: boolean,
  ) {
    super(
      gone
        ? 'Somebody else has removed this meanwhile: nothing was done.'
        : 'Somebody else has changed this meanwhile: it is shown as it is now, and nothing was done. Do it again if it is still right.',
    )
  }
}

/** Changes something that still is as it was shown; what others do in between has the relay refuse it.
 *
 * @param shown null: there was none
 * @throws Overtaken
 */
async function changed<T extends object>(method: string, at: string, shown: T | null, body: unknown): Promise<T> {
  const tag = await tagOf(at, shown)
  try {
    return await told<T>(method, at, body, tag === null ? { 'If-None-Match': '*' } : { 'If-Match': tag })
  } catch (error) {
    throw error instanceof Refusal && error.status === 412 ? new Overtaken(false) : error
  }
}

/** The entity tag of what is as it was shown; null of what is not there. */
async function tagOf<T extends object>(at: string, shown: T | null): Promise<string | null> {
  const answer = await found(at)
  if (answer === null) {
    if (shown !== null) throw new Overtaken(true)
    return null
  }
  const now = (await answer.json()) as Record<string, unknown>
  const same = Object.entries(shown ?? { none: null }).every(([name, value]) => JSON.stringify(value) === JSON.stringify(now[name]))
  if (!same) throw new Overtaken(false)
  return answer.headers.get('ETag')
}

async function found(at: string): Promise<Response | null> {
  try {
    return await request('GET', at)
  } catch (error) {
    if (error instanceof Refusal && error.status === 404) return null
    throw error
  }
}

async function part<T>(what: string, at: string, asked: Asked): Promise<Part<T>> {
  const given = Object.entries(asked).filter(([, value]) => value !== undefined && value !== '')
  const query = new URLSearchParams(given.map(([name, value]) => [name, String(value)])).toString()
  const { next, ...page } = await told<Record<string, T[]> & { next: string }>('GET', query === '' ? at : `${at}?${query}`)
  return { items: (page as Record<string, T[]>)[what] ?? [], next }
}

export const about = () => told<RealmAbout>('GET', path())

export const users = (asked: Asked) => part<RealmUser>('users', path('users'), asked)
export const groups = (asked: Asked) => part<RealmGroup>('groups', path('groups'), asked)
export const robots = (asked: Asked) => part<RealmRobot>('robots', path('robots'), asked)
export const rights = (asked: Asked) => part<RealmRight>('rights', path('rights'), asked)
export const keys = (robot: string, asked: Asked) => part<RealmKey>('keys', path('robots', robot, 'keys'), asked)
export const tokens = (user: string, asked: Asked) => part<RealmToken>('tokens', path('users', user, 'tokens'), asked)

/** Which keys a robot ever handed in. */
export async function fingerprints(robot: string): Promise<Set<string>> {
  const { items } = await gather((asked) => keys(robot, asked), AT_ONCE)
  return new Set(items.map(({ fingerprint }) => fingerprint))
}

export const addRobot = (name: string, description: string) => told<Enrolment>('POST', path('robots'), { name, description })
export const newCode = (robot: string) => told<Enrolment>('POST', path('robots', robot, 'code'))
export const removeRobot = (robot: string) => request('DELETE', path('robots', robot))
export const retireKey = (robot: string, fingerprint: string) => request('DELETE', path('robots', robot, 'keys', fingerprint))

/** @param password empty: only tokens let the user in */
export function addUser(name: string, password: string, admin: boolean): Promise<RealmUser> {
  return told('POST', path('users'), { name, admin, ...(password === '' ? {} : { password }) })
}

export type UserChange = Partial<{ password: string; disabled: boolean; admin: boolean }>
/** @param shown the user as he was shown to who changes him */
export const changeUser = (shown: RealmUser, change: UserChange) => changed('PATCH', path('users', shown.user), shown, change)
export const removeUser = (user: string) => request('DELETE', path('users', user))
export const revokeToken = (id: string) => request('DELETE', path('tokens', id))

export const addGroup = (name: string) => told<RealmGroup>('POST', path('groups'), { name })
export const removeGroup = (group: string) => request('DELETE', path('groups', group))
export const join = (group: string, user: string) => request('PUT', path('groups', group, 'members', user))
export const leave = (group: string, user: string) => request('DELETE', path('groups', group, 'members', user))

/** @param shown what the holder has there, as it was shown to who gives the right; null: none */
export function grant({ robot, holder, level, allow, deny }: RealmRight, shown: RealmRight | null): Promise<RealmRight> {
  return changed('PUT', path('rights', robot, holder), shown, { level, allow, deny })
}
export const revoke = ({ robot, holder }: RealmRight) => request('DELETE', path('rights', robot, holder))

/** A list up to a length, however many answers that takes. */
export async function gather<T>(ask: (asked: Asked) => Promise<Part<T>>, most: number): Promise<Part<T>> {
  const items: T[] = []
  let next = ''
  do {
    const page = await ask({ limit: Math.min(most - items.length, AT_ONCE), after: next })
    items.push(...page.items)
    next = page.next
  } while (next !== '' && items.length < most)
  return { items, next }
}

/** The right that a holder has on a robot, or null. */
export async function held(robot: string, holder: string): Promise<RealmRight | null> {
  return ((await (await found(path('rights', robot, holder)))?.json()) ?? null) as RealmRight | null
}
