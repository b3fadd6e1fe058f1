/** An administrator's own realm over HTTP (protocol/SPEC.md 1.16). Times in Unix seconds. */
import { request } from './api'
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

async function told<T>(method: string, at: string, body?: unknown): Promise<T> {
  return (await (await request(method, at, body)).json()) as T
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

export const addRobot = (name: string, description: string) => told<Enrolment>('POST', path('robots'), { name, description })
export const newCode = (robot: string) => told<Enrolment>('POST', path('robots', robot, 'code'))
export const removeRobot = (robot: string) => request('DELETE', path('robots', robot))
export const retireKey = (robot: string, fingerprint: string) => request('DELETE', path('robots', robot, 'keys', fingerprint))

/** @param password empty: only tokens let the user in */
export function addUser(name: string, password: string, admin: boolean): Promise<RealmUser> {
  return told('POST', path('users'), { name, admin, ...(password === '' ? {} : { password }) })
}

export type UserChange = Partial<{ password: string; disabled: boolean; admin: boolean }>
export const changeUser = (user: string, change: UserChange) => told<RealmUser>('PATCH', path('users', user), change)
export const removeUser = (user: string) => request('DELETE', path('users', user))
export const revokeToken = (id: string) => request('DELETE', path('tokens', id))

export const addGroup = (name: string) => told<RealmGroup>('POST', path('groups'), { name })
export const removeGroup = (group: string) => request('DELETE', path('groups', group))
export const join = (group: string, user: string) => request('PUT', path('groups', group, 'members', user))
export const leave = (group: string, user: string) => request('DELETE', path('groups', group, 'members', user))

export function grant({ robot, holder, level, allow, deny }: RealmRight): Promise<RealmRight> {
  return told('PUT', path('rights', robot, holder), { level, allow, deny })
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
  const { items } = await gather((asked) => rights({ ...asked, robot }), 25 * AT_ONCE)
  const wanted = holder.toLowerCase()
  return items.find((right) => right.holder === wanted) ?? null
}
