/** The relay's HTTP API, as far as the portal uses it. */
import { newStopId } from '../control/control'
import { sentence } from '../format'
import type { Filter } from './alerts'
import { Lines } from './fleetOrders'
import { addressOf, ask, Refusal, send, Unreachable } from './request'
import type {
  Alert,
  AlertPage,
  Camera,
  Credentials,
  Order,
  OrderKind,
  OrderLine,
  Provided,
  Recordable,
  Recording,
  RecordingPage,
  RecordingRequest,
  Robot,
  Session,
  Update,
} from './types'
import { ReceiveTimeout } from '../timeoutSignal'
import { Stream } from './updates'

/** The longest answer of the relay to a stop takes 21 s: 3 for the user, 3 for the robot's name, 15 for the robot. */
export const STOP_TIMEOUT_MS = 22_000
const SESSION_PATIENCE_MS = 10_000
/** Longest time for a freshness token, milliseconds: orders that move robots are executed soon after the press, or not at all. */
const MOMENT_PATIENCE_MS = 2_000
const FRESHNESS = 'switchboard-freshness'
/** Browsers complete requests of at most 64 KiB, all together, after a page is left. */
const KEPT_BYTES = 32_768

/** A freshness token for a request that moves a robot (SPEC 1.13): it proves that the request was made after now.
 *
 * @throws Unreachable when the answer takes so long that the token proves too little
 */
export async function moment(signal?: AbortSignal): Promise<string> {
  const asked = performance.now()
  const patience = new ReceiveTimeout(MOMENT_PATIENCE_MS, signal)
  try {
    const answer = await send('get', '/api/v1/fleet/groups', { signal: patience.signal })
    // After a freeze of the page, the answer is handled before the timer.
    if (performance.now() - asked > MOMENT_PATIENCE_MS) throw new Unreachable()
    return answer.headers.get(FRESHNESS) ?? ''
  } finally {
    patience.end()
  }
}

/** The user that is logged in, or null. */
export async function currentSession(): Promise<Session | null> {
  const patience = new ReceiveTimeout(SESSION_PATIENCE_MS)
  try {
    return await ask('get', '/api/v1/session', { signal: patience.signal })
  } catch (error) {
    if (error instanceof Refusal && error.status === 401) return null
    throw error
  } finally {
    patience.end()
  }
}

export function login(credentials: Credentials): Promise<Session> {
  return ask('post', '/api/v1/session', { body: credentials })
}

export async function logout(): Promise<void> {
  await send('delete', '/api/v1/session')
}

export function robot(name: string): Promise<Robot> {
  return ask('get', '/api/v1/robots/{robot}', { names: { robot: name } })
}

/** Actions of a type that the user may use. */
export async function actions(robot: string, type: string): Promise<Provided[]> {
  return (await ask('get', '/api/v1/robots/{robot}/actions', { names: { robot }, query: { type } })).actions
}

/** Stops a robot. Returns whether the stop is pending, because the robot is offline.
 *
 * @param stopId the id of the press, the same on all paths
 * @param signal ends the attempt: the robot is stopped already
 * @throws Refusal, also when a part of the stop failed
 * @throws Unreachable also when no answer comes for longer than the relay ever takes
 */
export async function stopRobot(name: string, why = '', stopId = newStopId(), signal?: AbortSignal): Promise<boolean> {
  const patience = new ReceiveTimeout(STOP_TIMEOUT_MS, signal)
  try {
    // The request is sent even if the page is left at once.
    const options = { names: { robot: name }, body: { why, stop_id: stopId }, keepalive: true, signal: patience.signal }
    return (await send('post', '/api/v1/robots/{robot}/stop', options)).status === 202
  } finally {
    patience.end()
  }
}

/** Alerts of all the user's robots, the latest first, including those that are over.
 *
 * @param before `next` of the previous part
 */
export function alerts({ robot, state }: Filter, limit: number, before: string | null): Promise<AlertPage> {
  const open = state === 'all' ? '' : state === 'open' ? 'true' : 'false'
  return ask('get', '/api/v1/alerts', { query: { limit, robot, open, before: before ?? '' } })
}

export function acknowledge(id: string): Promise<Alert> {
  return ask('post', '/api/v1/alerts/{id}/acknowledge', { names: { id } })
}

const DATED = new Set<OrderKind>(['resume', 'call', 'set'])

/** Gives one order to many robots, and passes on each line of the answer.
 *
 * @param signal cancels the order on the robots that it has not reached; a stop continues on the relay
 * @param asked freshness token from the beginning of the press, for an order to resume
 * @throws Unreachable also when the answer breaks off, or the answer to a stop stalls
 */
export async function giveOrder(order: Order, take: (line: OrderLine) => void, signal?: AbortSignal, asked?: Promise<string>): Promise<void> {
  const stops = order.do === 'stop'
  const dated = asked ?? (DATED.has(order.do) ? moment(signal) : null)
  const headers: Record<string, string> = dated === null ? {} : { [FRESHNESS]: await dated }
  const patience = new ReceiveTimeout(stops ? STOP_TIMEOUT_MS : null, signal)
  try {
    // An order to stop is sent even if the page is left at once.
    const body = stops ? { stop_id: newStopId(), ...order } : order
    const keepalive = stops && new TextEncoder().encode(JSON.stringify(body)).length <= KEPT_BYTES
    const answer = await send('post', '/api/v1/fleet', { body, signal: patience.signal, keepalive, headers })
    await readLines(answer, take, patience)
  } finally {
    patience.end()
  }
}

async function readLines(answer: Response, take: (line: OrderLine) => void, patience: ReceiveTimeout): Promise<void> {
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
  return (await ask('get', '/api/v1/fleet/groups')).groups.map(({ name }) => name)
}

/** The cameras of a robot that the user may view. */
export async function cameras(name: string): Promise<Camera[]> {
  return (await ask('get', '/robots/{robot}/video/cameras', { names: { robot: name } })).cameras
}

/** The recordings of a robot that the user may download, the latest first, and whether there are older ones.
 *
 * @param most number of recordings; the relay sends 100 by default, and some hundreds at most
 */
export async function recordings(name: string, most: number): Promise<{ list: Recording[]; more: boolean }> {
  const list: Recording[] = []
  let next: string | null = null
  do {
    const limit = Math.min(most - list.length, 500)
    const page: RecordingPage = await ask('get', '/api/v1/robots/{robot}/recordings', {
      names: { robot: name },
      query: { limit, before: next ?? '' },
    })
    list.push(...page.recordings)
    next = page.next
  } while (next !== null && list.length < most)
  return { list, more: next !== null }
}

/** Topics and cameras that can be recorded now. */
export function recordable(name: string): Promise<Recordable> {
  return ask('get', '/api/v1/robots/{robot}/recordings/new', { names: { robot: name } })
}

export async function startRecording(name: string, wanted: RecordingRequest): Promise<void> {
  await send('post', '/api/v1/robots/{robot}/recordings', { names: { robot: name }, body: wanted })
}

export async function stopRecording(name: string, id: string): Promise<void> {
  await send('post', '/api/v1/robots/{robot}/recordings/{id}/stop', { names: { robot: name, id } })
}

export async function deleteRecording(name: string, id: string): Promise<void> {
  await send('delete', '/api/v1/robots/{robot}/recordings/{id}', { names: { robot: name, id } })
}

/** Address of the file of a recording. */
export function recordingFile(name: string, id: string): string {
  return addressOf('/api/v1/robots/{robot}/recordings/{id}/file', { robot: name, id })
}

export interface FleetWatcher {
  robots(list: Robot[]): void
  /** Alerts that are open, or ended a moment ago. */
  alerts(list: Alert[]): void
  /** The relay is reachable, but does not know the state, for this reason. */
  unknown(why: string): void
  /** Milliseconds without a message. */
  silent(ms: number): void
  /** The connection has ended, and the next attempt follows; with the relay's reason, or empty. */
  gone(why: string): void
}

/** Follows robots and alerts until it is closed. */
export function fleetStream(watcher: FleetWatcher, page: Place): Stream {
  return new Stream(fleetSocket(page), {
    received: (event, data) => {
      const update = data as Update
      if (event === 'robots' && 'robots' in update) watcher.robots(update.robots)
      if (event === 'alerts' && 'alerts' in update) watcher.alerts(update.alerts)
      if (event === 'unknown' && 'reason' in update) watcher.unknown(sentence(update.reason))
    },
    silent: (ms) => watcher.silent(ms),
    gone: (why) => watcher.gone(sentence(why)),
  })
}

type Place = Pick<Location, 'protocol' | 'host'>

function socketAddress(path: string, page: Place): string {
  return `${page.protocol === 'https:' ? 'wss' : 'ws'}://${page.host}${path}`
}

/** URL of the websocket of all robots of the user. */
export function fleetSocket(page: Place): string {
  return socketAddress('/api/v1/robots/stream', page)
}

/** URL of the rosbridge websocket of a robot. */
export function robotSocket(name: string, page: Place): string {
  return socketAddress(`/robots/${encodeURIComponent(name)}`, page)
}

/** URL of the video stream of a camera.
 *
 * @param query parameters of the stream, see `parameters` in `video.ts`
 */
export function videoSocket(name: string, query: string, page: Place): string {
  return `${robotSocket(name, page)}/video/ws?${query}`
}
