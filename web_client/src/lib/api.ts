/** The relay's HTTP API, as far as the portal uses it. */
import type { Alert, Filter, Page } from './alerts'
import { sentence } from './format'
import { Lines, type Order } from './orders'
import type { Possible, Recording, RecordingAsk, Robot, Session } from './types'
import { Patience } from './patience'
import { Stream } from './stream'
import type { Camera } from './video'

/** A request the relay refused, in its own words. */
export class Refusal extends Error {
  constructor(
    readonly status: number,
    message: string,
    /** Seconds to wait before trying again, when the relay said so. */
    readonly retryAfter: number | null = null,
  ) {
    super(message)
  }

  /** Whether it is the robot that said what it could not do (protocol/SPEC.md 1.7). */
  get byRobot(): boolean {
    return this.status === 409
  }
}

/** The relay did not answer at all. */
export class Unreachable extends Error {
  constructor() {
    super('The relay does not answer. Check the network, then try again.')
  }
}

/** The relay's own longest answer to a stop takes 21 s: who asks 3, which robot 3, what the robot says 15. */
export const STOP_PATIENCE_MS = 22_000
const SESSION_PATIENCE_MS = 10_000
/** What moves robots, or lets them move, is done soon after it was asked for, or not at all. */
const MOMENT_PATIENCE_MS = 2_000
const MOMENT = 'switchboard-moment'
/** Browsers let no more than 64 KiB go on when a page is left, all of it together. */
const KEPT_BYTES = 32_768

const HEADERS = { Accept: 'application/json', 'X-Requested-With': 'switchboard' }

type More = RequestInit & { headers?: Record<string, string> }

/** Asks the relay, with what the session's cookie needs beside it.
 *
 * @throws Refusal, Unreachable
 */
export async function request(method: string, path: string, body?: unknown, more: More = {}): Promise<Response> {
  const headers: Record<string, string> = { ...HEADERS }
  if (body !== undefined) headers['Content-Type'] = 'application/json'
  let response: Response
  try {
    response = await fetch(path, {
      method,
      credentials: 'same-origin',
      ...more,
      headers: { ...headers, ...more.headers },
      ...(body === undefined ? {} : { body: JSON.stringify(body) }),
    })
  } catch {
    throw new Unreachable()
  }
  if (!response.ok) throw await refusal(response)
  return response
}

/** What dates a request that follows: the relay takes none that may be older, however long it was held up (SPEC.md 1.13).
 *
 * @throws Unreachable when the relay takes so long to name a moment that it says nothing of when this was asked for
 */
export async function moment(signal?: AbortSignal): Promise<string> {
  const asked = performance.now()
  const patience = new Patience(MOMENT_PATIENCE_MS, signal)
  try {
    const answer = await request('GET', '/api/v1/fleet/groups', undefined, { signal: patience.signal })
    // A page that was frozen finds the answer before its timer.
    if (performance.now() - asked > MOMENT_PATIENCE_MS) throw new Unreachable()
    return answer.headers.get(MOMENT) ?? ''
  } finally {
    patience.end()
  }
}

/** What the relay said in a refused answer (RFC 9457 problem details). */
export async function refusal(response: Response): Promise<Refusal> {
  const wait = Number(response.headers.get('Retry-After'))
  const retryAfter = Number.isFinite(wait) && wait > 0 ? wait : null
  let words = ''
  try {
    const problem: unknown = await response.json()
    if (typeof problem === 'object' && problem !== null) {
      const { detail, title } = problem as { detail?: unknown; title?: unknown }
      words = [detail, title].find((w): w is string => typeof w === 'string' && w !== '') ?? ''
    }
  } catch {
    // Not JSON: a proxy in between, for example. The status has to do.
  }
  return new Refusal(response.status, sentence(words) || `The relay answered with error ${response.status}.`, retryAfter)
}

/** Who is logged in, or null. */
export async function currentSession(): Promise<Session | null> {
  const patience = new Patience(SESSION_PATIENCE_MS)
  try {
    return (await (await request('GET', '/api/v1/session', undefined, { signal: patience.signal })).json()) as Session
  } catch (error) {
    if (error instanceof Refusal && error.status === 401) return null
    throw error
  } finally {
    patience.end()
  }
}

export type Credentials = { user: string; password: string } | { code: string }

export async function login(credentials: Credentials): Promise<Session> {
  return (await (await request('POST', '/api/v1/session', credentials)).json()) as Session
}

export async function logout(): Promise<void> {
  await request('DELETE', '/api/v1/session')
}

function robotPath(name: string, below = ''): string {
  return `/api/v1/robots/${encodeURIComponent(name)}${below}`
}

export async function robot(name: string): Promise<Robot> {
  return (await (await request('GET', robotPath(name))).json()) as Robot
}

/** Stops a robot. Returns whether that is still to come, because the robot is away.
 *
 * @throws Refusal, also when the robot could not do all of it
 * @throws Unreachable also when no answer comes for longer than the relay ever takes
 */
export async function stopRobot(name: string, why = ''): Promise<boolean> {
  const patience = new Patience(STOP_PATIENCE_MS)
  try {
    // It goes out even when the page is left in the same moment.
    const more = { keepalive: true, signal: patience.signal }
    return (await request('POST', robotPath(name, '/stop'), { why }, more)).status === 202
  } finally {
    patience.end()
  }
}

/** Alerts of all the user's robots, also those that are long over; the latest first.
 *
 * @param before what an earlier answer gave as `next`: only those that are older than it told
 */
export async function alerts({ robot, state }: Filter, limit: number, before: string | null): Promise<Page> {
  const query = new URLSearchParams({ limit: String(limit) })
  if (robot !== '') query.set('robot', robot)
  if (state !== 'all') query.set('open', String(state === 'open'))
  if (before !== null) query.set('before', before)
  return (await (await request('GET', `/api/v1/alerts?${query}`)).json()) as Page
}

export async function acknowledge(id: string): Promise<Alert> {
  return (await (await request('POST', `/api/v1/alerts/${encodeURIComponent(id)}/acknowledge`, {})).json()) as Alert
}

const DATED = new Set<Order['do']>(['resume', 'call', 'set'])

/** Gives one order to many robots and hands on each line of the answer as it comes.
 *
 * @param signal ends it: what has not begun is not done; of an order to stop only the listening ends
 * @param asked when it was asked for, where that was not now: to resume robots, when the press began
 * @throws Unreachable also when the answer breaks off, and when nothing more comes of the answer to a stop
 */
export async function giveOrder(order: Order, take: (line: object) => void, signal?: AbortSignal, asked?: Promise<string>): Promise<void> {
  const stops = order.do === 'stop'
  const dated = asked ?? (DATED.has(order.do) ? moment(signal) : null)
  const headers: Record<string, string> = dated === null ? {} : { [MOMENT]: await dated }
  const patience = new Patience(stops ? STOP_PATIENCE_MS : null, signal)
  try {
    // An order to stop goes out even when the page is left in the same moment.
    const keepalive = stops && new TextEncoder().encode(JSON.stringify(order)).length <= KEPT_BYTES
    const answer = await request('POST', '/api/v1/fleet', order, { signal: patience.signal, keepalive, headers })
    await readLines(answer, take, patience)
  } finally {
    patience.end()
  }
}

async function readLines(answer: Response, take: (line: object) => void, patience: Patience): Promise<void> {
  const lines = new Lines()
  const words = new TextDecoder()
  const reader = answer.body?.getReader()
  const next = () => reader?.read().catch(() => Promise.reject(new Unreachable()))
  for (let part = await next(); part !== undefined && !part.done; part = await next()) {
    patience.begin()
    lines.take(words.decode(part.value, { stream: true })).forEach(take)
  }
}

/** Names of the groups in which the user has robots. */
export async function groups(): Promise<string[]> {
  const answer = (await (await request('GET', '/api/v1/fleet/groups')).json()) as { groups: { name: string }[] }
  return answer.groups.map(({ name }) => name)
}

/** The cameras of a robot that the user may view. */
export async function cameras(name: string): Promise<Camera[]> {
  const answer = await request('GET', `/robots/${encodeURIComponent(name)}/video/cameras`)
  return ((await answer.json()) as { cameras: Camera[] }).cameras
}

function recordingsPath(name: string, below = ''): string {
  return robotPath(name, `/recordings${below}`)
}

/** The recordings of a robot that the user may have, the latest first; and whether there are older ones.
 *
 * @param most how many; the relay gives some hundreds at a time, 100 if not asked for more
 */
export async function recordings(name: string, most: number): Promise<{ list: Recording[]; more: boolean }> {
  const list: Recording[] = []
  let next: string | null = null
  do {
    const wanted = Math.min(most - list.length, 500)
    const query: string[] = []
    if (wanted !== 100) query.push(`limit=${wanted}`)
    if (next !== null) query.push(`before=${encodeURIComponent(next)}`)
    const answer = await request('GET', recordingsPath(name, query.length === 0 ? '' : `?${query.join('&')}`))
    const page = (await answer.json()) as { recordings: Recording[]; next: string | null }
    list.push(...page.recordings)
    next = page.next
  } while (next !== null && list.length < most)
  return { list, more: next !== null }
}

/** What the user could record of a robot now. */
export async function recordable(name: string): Promise<Possible> {
  return (await (await request('GET', recordingsPath(name, '/new'))).json()) as Possible
}

export async function startRecording(name: string, ask: RecordingAsk): Promise<void> {
  await request('POST', recordingsPath(name), ask)
}

export async function stopRecording(name: string, id: string): Promise<void> {
  await request('POST', recordingsPath(name, `/${id}/stop`))
}

export async function deleteRecording(name: string, id: string): Promise<void> {
  await request('DELETE', recordingsPath(name, `/${id}`))
}

/** Where the file of a recording is. */
export function recordingFile(name: string, id: string): string {
  return recordingsPath(name, `/${id}/file`)
}

export interface FleetWatcher {
  robots(list: Robot[]): void
  /** Those that are open, or were over a moment ago. */
  alerts(list: Alert[]): void
  /** The relay is there and can't tell how things are, for this reason. */
  unknown(why: string): void
  /** Nothing was heard for so many milliseconds. */
  silent(ms: number): void
  /** The connection is over, and another one is tried; with the relay's words, or none. */
  gone(why: string): void
}

/** What follows robots and alerts once it is opened, until it is closed. */
export function fleetStream(watcher: FleetWatcher, page: Place): Stream {
  return new Stream(socketAddress('/api/v1/robots/stream', page), {
    told: (event, data) => {
      const { robots, alerts, reason } = data as { robots?: Robot[]; alerts?: Alert[]; reason?: string }
      if (event === 'robots' && robots !== undefined) watcher.robots(robots)
      if (event === 'alerts' && alerts !== undefined) watcher.alerts(alerts)
      if (event === 'unknown') watcher.unknown(sentence(reason ?? ''))
    },
    silent: (ms) => watcher.silent(ms),
    gone: (why) => watcher.gone(sentence(why)),
  })
}

type Place = Pick<Location, 'protocol' | 'host'>

function socketAddress(path: string, page: Place): string {
  return `${page.protocol === 'https:' ? 'wss' : 'ws'}://${page.host}${path}`
}

/** Where the rosbridge websocket of a robot is, seen from a page. */
export function robotSocket(name: string, page: Place): string {
  return socketAddress(`/robots/${encodeURIComponent(name)}`, page)
}

/** Where the pictures of a camera are.
 *
 * @param query what is wanted, see `parameters` in `video.ts`
 */
export function videoSocket(name: string, query: string, page: Place): string {
  return `${robotSocket(name, page)}/video/ws?${query}`
}
