/** The relay's HTTP API, as far as the portal uses it. */
import { sentence } from './format'
import type { Robot, Session } from './types'
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

async function request(method: string, path: string, body?: unknown): Promise<Response> {
  const headers: Record<string, string> = { ...HEADERS }
  if (body !== undefined) headers['Content-Type'] = 'application/json'
  let response: Response
  try {
    response = await fetch(path, {
      method,
      headers,
      credentials: 'same-origin',
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

export async function robot(name: string): Promise<Robot> {
  return (await (await request('GET', `/api/v1/robots/${encodeURIComponent(name)}`)).json()) as Robot
}

/** The cameras of a robot that the user may view. */
export async function cameras(name: string): Promise<Camera[]> {
  const answer = await request('GET', `/robots/${encodeURIComponent(name)}/video/cameras`)
  return ((await answer.json()) as { cameras: Camera[] }).cameras
}

export interface FleetWatcher {
  robots(list: Robot[]): void
  /** The stream broke; the browser tries again by itself unless `final`. */
  lost(final: boolean): void
}

/** Follows the list of robots until the returned function is called. */
export function watchFleet(watcher: FleetWatcher): () => void {
  const source = new EventSource('/api/v1/robots/stream')
  source.addEventListener('robots', (event: MessageEvent<string>) => {
    watcher.robots((JSON.parse(event.data) as { robots: Robot[] }).robots)
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
