/** Requests to the relay's HTTP API, typed by its OpenAPI document, and the errors they end with. */
import { sentence } from '../format'
import { learnRelayTime } from '../relayClock'
import type { paths } from './schema'

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

  /** Whether the error comes from the robot (SPEC 1.7). */
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

type Method = 'get' | 'post' | 'put' | 'patch' | 'delete'

/** Paths of the API that take a method. */
export type Path<M extends Method> = {
  [P in keyof paths]: paths[P] extends Record<M, object> ? P : never
}[keyof paths]

type Json<T> = T extends { content: { 'application/json': infer Body } } ? Body : never
type Parameters<P extends keyof paths, M extends Method> = paths[P][M] extends { parameters: infer Found } ? Found : never

/** What a request may carry, see `send`. */
export interface Options<P extends keyof paths, M extends Method> extends Omit<RequestInit, 'body' | 'headers' | 'method'> {
  /** Values for `{name}` in the path. */
  names?: Parameters<P, M> extends { path: infer Names } ? Names : never
  /** Empty and missing values are left out. */
  query?: Parameters<P, M> extends { query?: infer Query } ? Query : never
  body?: paths[P][M] extends { requestBody?: infer Body } ? Json<NonNullable<Body>> : never
  headers?: Record<string, string>
  /** A body that is not JSON. */
  raw?: Blob
}

/** The JSON of a successful answer. */
export type Answer<P extends keyof paths, M extends Method> = paths[P][M] extends { responses: infer Found }
  ? { [Status in keyof Found & (200 | 201 | 202)]: Json<Found[Status]> }[keyof Found & (200 | 201 | 202)]
  : never

const HEADERS = { Accept: 'application/json', 'X-Requested-With': 'switchboard' }

/** Sends a request, with the headers that a session cookie needs.
 *
 * @throws Refusal, Unreachable
 */
export async function send<M extends Method, P extends Path<M>>(method: M, path: P, options: Options<P, M> = {}): Promise<Response> {
  const { names, query, body, raw, headers, ...more } = options
  const content = body === undefined ? raw : JSON.stringify(body)
  const sent: Record<string, string> = { ...HEADERS, ...headers }
  if (body !== undefined) sent['Content-Type'] = 'application/json'
  let response: Response
  const sentMs = Date.now()
  try {
    response = await fetch(addressOf(path, names as object, query as object), {
      method: method.toUpperCase(),
      credentials: 'same-origin',
      ...more,
      headers: sent,
      body: content,
    })
  } catch {
    throw new Unreachable()
  }
  learnRelayTime(response.headers.get('Date'), sentMs)
  if (!response.ok) throw await refusal(response)
  return response
}

/** Sends a request and reads the JSON of the answer.
 *
 * @throws Refusal, Unreachable
 */
export async function ask<M extends Method, P extends Path<M>>(
  method: M,
  path: P,
  options: Options<P, M> = {},
): Promise<Answer<P, M>> {
  return (await (await send(method, path, options)).json()) as Answer<P, M>
}

/** A path of the API with names and query filled in. */
export function addressOf(path: keyof paths, names: object = {}, query: object = {}): string {
  const found: Record<string, unknown> = { ...names }
  // `@` before the name of a group stays as it is.
  const filled = path.replaceAll(/\{(\w+)\}/g, (_, name: string) => encodeURIComponent(String(found[name])).replace(/^%40/, '@'))
  const given = Object.entries(query).filter(([, value]) => value !== undefined && value !== '')
  const words = new URLSearchParams(given.map(([name, value]) => [name, String(value)])).toString()
  return words === '' ? filled : `${filled}?${words}`
}

/** Error message of an answer (RFC 9457 problem details). */
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
