/** Live updates of all robots for a page (SPEC 1.7).
 *
 * By websocket: server-sent events of six tabs would use all connections of the browser to the relay.
 */
import { pause } from './backoff'

/** The relay sends at least every 5 s. After this time without a message it counts as lost, milliseconds. */
export const SILENT_MS = 8000
/** After this time without a message a new connection is opened, milliseconds. */
export const DEAD_MS = 15_000
const CHECK_MS = 1000
/** A check that is later than this shows that the page was frozen, milliseconds. */
const HELD_UP_MS = 3000

export interface StreamEvents {
  received(event: string, data: unknown): void
  /** Milliseconds without a message; called repeatedly until one arrives. */
  silent(ms: number): void
  /** The connection has ended; the next attempt follows after a pause. `why` is the reason of the relay, or empty. */
  gone(why: string): void
}

export class Stream {
  private socket: WebSocket | null = null
  private heardMs = 0
  private lookedMs = 0
  private heldUp = false
  private attempt = 0
  private checking: ReturnType<typeof setInterval> | undefined
  private retry: ReturnType<typeof setTimeout> | undefined

  constructor(
    private readonly url: string,
    private readonly events: StreamEvents,
  ) {}

  open(): void {
    this.lookedMs = performance.now()
    this.checking = setInterval(() => this.checkSilence(), CHECK_MS)
    this.dial()
  }

  close(): void {
    clearInterval(this.checking)
    clearTimeout(this.retry)
    this.drop()
  }

  /** Sends a message if the websocket is open; otherwise it is lost. */
  send(message: object): void {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message))
  }

  /** Tries at once instead of waiting for the pause to end. */
  retryNow(): void {
    if (this.socket === null) this.dial()
  }

  private dial(): void {
    clearTimeout(this.retry)
    const socket = new WebSocket(this.url)
    this.socket = socket
    this.heardMs = performance.now()
    socket.onmessage = ({ data }) => this.take(data as string)
    socket.onclose = ({ reason }) => this.over(reason)
  }

  private take(text: string): void {
    this.heardMs = performance.now()
    this.attempt = 0
    const { event, data } = JSON.parse(text) as { event: string; data: unknown }
    this.events.received(event, data)
  }

  private over(why: string): void {
    this.drop()
    this.retry = setTimeout(() => this.dial(), pause(this.attempt++, Math.random()))
    this.events.gone(why)
  }

  /** A dead link may take minutes to report its close, so it is not awaited. */
  private drop(): void {
    const socket = this.socket
    this.socket = null
    if (socket === null) return
    socket.onmessage = socket.onclose = null
    socket.close()
  }

  private checkSilence(): void {
    const now = performance.now()
    const late = now - this.lookedMs > HELD_UP_MS
    // After a freeze, messages may wait to be read. So silence counts only if the page was not frozen.
    const wait = late && !this.heldUp
    this.lookedMs = now
    this.heldUp = late
    const silent = now - this.heardMs
    if (wait || this.socket === null || silent < SILENT_MS) return
    this.events.silent(silent)
    if (silent >= DEAD_MS) this.over('')
  }
}
