/** The realm of an administrator over HTTP (SPEC 1.16). Times in Unix seconds. */
import { type Answer, ask, type Options, type Path, Refusal, send } from './request'
import type { Enrolment, RealmAbout, RealmGroup, RealmKey, RealmRight, RealmRobot, RealmToken, RealmUser, UserChange } from './types'

/** A part of a list, sorted by name; `next` is the cursor of the next part, empty after the last one. */
export interface Part<T> {
  items: T[]
  next: string
}

/** Query of a list: `name` is a pattern with wildcards. */
export type Asked = Partial<Record<'name' | 'after' | 'robot' | 'user', string>> & { limit?: number }

/** Most items of one answer of the relay. */
export const AT_ONCE = 1000

/** Another user has changed the item, so nothing was done. */
export class Superseded extends Error {
  constructor(
    /** Whether the item was removed. */
    readonly gone: boolean,
  ) {
    super(
      gone
        ? 'Another user has removed this. Your change was not saved.'
        : 'Another user has changed this. The current state is shown, and your change was not saved. Try again if it still applies.',
    )
  }
}

const USER = '/api/v1/realm/users/{name}'
const RIGHT = '/api/v1/realm/rights/{name}/{holder}'

/** The headers with which the relay changes an item only if it still is as shown.
 *
 * @param answer of a request for the item now; null when there is none
 * @param shown null: there was none
 * @throws Superseded
 */
async function asShown(answer: Response | null, shown: object | null): Promise<Record<string, string>> {
  if (answer === null) {
    if (shown !== null) throw new Superseded(true)
    return { 'If-None-Match': '*' }
  }
  const now = (await answer.json()) as Record<string, unknown>
  const same = Object.entries(shown ?? { none: null }).every(([name, value]) => JSON.stringify(value) === JSON.stringify(now[name]))
  if (!same) throw new Superseded(false)
  return { 'If-Match': answer.headers.get('ETag') ?? '' }
}

/** The result of a change, unless the item was changed by someone else in between.
 *
 * @throws Superseded
 */
async function unlessSuperseded<T>(change: Promise<T>): Promise<T> {
  try {
    return await change
  } catch (error) {
    throw error instanceof Refusal && error.status === 412 ? new Superseded(false) : error
  }
}

async function found<P extends Path<'get'>>(path: P, options: Options<P, 'get'>): Promise<Response | null> {
  try {
    return await send('get', path, options)
  } catch (error) {
    if (error instanceof Refusal && error.status === 404) return null
    throw error
  }
}

export const about = (): Promise<RealmAbout> => ask('get', '/api/v1/realm')

export async function users(query: Asked): Promise<Part<RealmUser>> {
  const { users, next } = await ask('get', '/api/v1/realm/users', { query })
  return { items: users, next }
}

export async function groups(query: Asked): Promise<Part<RealmGroup>> {
  const { groups, next } = await ask('get', '/api/v1/realm/groups', { query })
  return { items: groups, next }
}

export async function robots(query: Asked): Promise<Part<RealmRobot>> {
  const { robots, next } = await ask('get', '/api/v1/realm/robots', { query })
  return { items: robots, next }
}

export async function rights(query: Asked): Promise<Part<RealmRight>> {
  const { rights, next } = await ask('get', '/api/v1/realm/rights', { query })
  return { items: rights, next }
}

export async function keys(robot: string, query: Asked): Promise<Part<RealmKey>> {
  const { keys, next } = await ask('get', '/api/v1/realm/robots/{name}/keys', { names: { name: robot }, query })
  return { items: keys, next }
}

export async function tokens(user: string, query: Asked): Promise<Part<RealmToken>> {
  const { tokens, next } = await ask('get', '/api/v1/realm/users/{name}/tokens', { names: { name: user }, query })
  return { items: tokens, next }
}

/** All keys that a robot has ever had. */
export async function fingerprints(robot: string): Promise<Set<string>> {
  const { items } = await fetchAllPages((query) => keys(robot, query), AT_ONCE)
  return new Set(items.map(({ fingerprint }) => fingerprint))
}

export const addRobot = (name: string, description: string): Promise<Enrolment> =>
  ask('post', '/api/v1/realm/robots', { body: { name, description } })
export const newCode = (robot: string): Promise<Enrolment> => ask('post', '/api/v1/realm/robots/{name}/code', { names: { name: robot } })
export const removeRobot = (robot: string) => send('delete', '/api/v1/realm/robots/{name}', { names: { name: robot } })
export const retireKey = (robot: string, fingerprint: string) =>
  send('delete', '/api/v1/realm/robots/{name}/keys/{fingerprint}', { names: { name: robot, fingerprint } })

/** @param password empty: login by access tokens only */
export function addUser(name: string, password: string, admin: boolean): Promise<RealmUser> {
  return ask('post', '/api/v1/realm/users', { body: { name, admin, ...(password === '' ? {} : { password }) } })
}

/** @param shown the user as shown */
export async function changeUser(shown: RealmUser, change: UserChange): Promise<RealmUser> {
  const names = { name: shown.user }
  const headers = await asShown(await found(USER, { names }), shown)
  return unlessSuperseded(ask('patch', USER, { names, body: change, headers }))
}
export const removeUser = (user: string) => send('delete', USER, { names: { name: user } })
export const revokeToken = (id: string) => send('delete', '/api/v1/realm/tokens/{id}', { names: { id } })

export const addGroup = (name: string): Promise<RealmGroup> => ask('post', '/api/v1/realm/groups', { body: { name } })
export const removeGroup = (group: string) => send('delete', '/api/v1/realm/groups/{name}', { names: { name: group } })
export const join = (group: string, user: string) =>
  send('put', '/api/v1/realm/groups/{name}/members/{user}', { names: { name: group, user } })
export const leave = (group: string, user: string) =>
  send('delete', '/api/v1/realm/groups/{name}/members/{user}', { names: { name: group, user } })

/** @param shown the existing right as shown; null for none */
export async function grant({ robot, holder, level, allow, deny }: RealmRight, shown: RealmRight | null): Promise<RealmRight> {
  const names = { name: robot, holder }
  const headers = await asShown(await found(RIGHT, { names }), shown)
  return unlessSuperseded(ask('put', RIGHT, { names, body: { level, allow, deny }, headers }))
}
export const revoke = ({ robot, holder }: RealmRight) => send('delete', RIGHT, { names: { name: robot, holder } })

/** A list up to a length, from as many answers as needed. */
export async function fetchAllPages<T>(ask: (asked: Asked) => Promise<Part<T>>, most: number): Promise<Part<T>> {
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
  const answer = await found(RIGHT, { names: { name: robot, holder } })
  return answer === null ? null : ((await answer.json()) as Answer<typeof RIGHT, 'get'>)
}
