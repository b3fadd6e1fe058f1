/** The relay's HTTP API, as far as the portal uses it. */
import type { Alert } from './alerts'
import { sentence } from './format'
import { Lines, type Order } from './orders'
import type { Possible, Recording, RecordingAsk, Robot, Session } from './types'
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
}

/** The relay did not answer at all. */
export class Unreachable extends Error {
  constructor() {
    super('The relay does not answer. Check the network, then try again.')
  }
}

const HEADERS = { Accept: 'application/json', 'X-Requested-With': 'switchboard' }

async function request(method: string, path: string, body?: unknown, more: RequestInit = {}): Promise<Response> {
  const headers: Record<string, string> = { ...HEADERS }
  if (body !== undefined) headers['Content-Type'] = 'application/json'
  let response: Response
  try {
    response = await fetch(path, {
      method,
      headers,
      credentials: 'same-origin',
      ...more,
      ...(body === undefined ? {} : { body: JSON.stringify(body) }),
    })
  } catch {
    throw new Unreachable()
  }
  if (!response.ok) throw await refusal(response)
  return response
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
  try {
    return (await (await request('GET', '/api/v1/session')).json()) as Session
  } catch (error) {
    if (error instanceof Refusal && error.status === 401) return null
    throw error
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
 */
export async function stopRobot(name: string, why = ''): Promise<boolean> {
  // It goes out even when the page is left in the same moment.
  return (await request('POST', robotPath(name, '/stop'), { why }, { keepalive: true })).status === 202
}

export async function resumeRobot(name: string, why = ''): Promise<void> {
  await request('POST', robotPath(name, '/resume'), { why })
}

/** Alerts of all the user's robots, also those that are long over; the latest first. */
export async function alerts(robot: string, open: boolean | null, limit: number): Promise<Alert[]> {
  const query = new URLSearchParams({ limit: String(limit) })
  if (robot !== '') query.set('robot', robot)
  if (open !== null) query.set('open', String(open))
  return ((await (await request('GET', `/api/v1/alerts?${query}`)).json()) as { alerts: Alert[] }).alerts
}

export async function acknowledge(id: string): Promise<Alert> {
  return (await (await request('POST', `/api/v1/alerts/${encodeURIComponent(id)}/acknowledge`, {})).json()) as Alert
}

/** Gives one order to many robots and hands on each line of the answer as it comes.
 *
 * @param signal ends it: what has not begun is not done; of an order to stop only the listening ends
 */
export async function giveOrder(order: Order, take: (line: object) => void, signal?: AbortSignal): Promise<void> {
  // An order to stop goes out even when the page is left in the same moment.
  const answer = await request('POST', '/api/v1/fleet', order, { signal: signal ?? null, keepalive: order.do === 'stop' })
  const lines = new Lines()
  const words = new TextDecoder()
  const reader = answer.body?.getReader()
  for (let part = await reader?.read(); part !== undefined && !part.done; part = await reader?.read()) {
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

/** The recordings of a robot that the user may have, the latest first. */
export async function recordings(name: string): Promise<Recording[]> {
  const answer = await request('GET', recordingsPath(name))
  return ((await answer.json()) as { recordings: Recording[] }).recordings
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
  /** The stream broke; the browser tries again by itself unless `final`. */
  lost(final: boolean): void
}

/** Follows robots and alerts until the returned function is called. */
export function watchFleet(watcher: FleetWatcher): () => void {
  const source = new EventSource('/api/v1/robots/stream')
  source.addEventListener('robots', (event: MessageEvent<string>) => {
    watcher.robots((JSON.parse(event.data) as { robots: Robot[] }).robots)
  })
  source.addEventListener('alerts', (event: MessageEvent<string>) => {
    watcher.alerts((JSON.parse(event.data) as { alerts: Alert[] }).alerts)
  })
  source.onerror = () => watcher.lost(source.readyState === EventSource.CLOSED)
  return () => source.close()
}

/** Where the rosbridge websocket of a robot is, seen from a page. */
export function robotSocket(name: string, page: Pick<Location, 'protocol' | 'host'>): string {
  const scheme = page.protocol === 'https:' ? 'wss' : 'ws'
  return `${scheme}://${page.host}/robots/${encodeURIComponent(name)}`
}

/** Where the pictures of a camera are.
 *
 * @param query what is wanted, see `parameters` in `video.ts`
 */
export function videoSocket(name: string, query: string, page: Pick<Location, 'protocol' | 'host'>): string {
  return `${robotSocket(name, page)}/video/ws?${query}`
}
