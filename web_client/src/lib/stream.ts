/** What the relay tells a page of all robots, for as long as the page is open (protocol/SPEC.md 1.7).
 *
 * A websocket, not server-sent events: of those, six tabs would take all connections the browser has to the relay.
 */
import { pause } from './backoff'

/** The relay tells something at least every 5 s. After so long without anything it counts as lost, milliseconds. */
export const SILENT_MS = 8000
/** After so long the connection is given up for another one. */
export const DEAD_MS = 15_000
const LOOK_MS = 1000
/** Looks that come later than this were held up, as the page was. */
const HELD_UP_MS = 3000

export interface StreamEvents {
  told(event: string, data: unknown): void
  /** Nothing was heard for so many milliseconds. Said again and again, until something is told. */
  silent(ms: number): void
  /** The connection is over; another one is tried after a pause. `why` is what the relay said, or empty. */
  gone(why: string): void
}

export class Stream {
  private socket: WebSocket | null = null
  private heardMs = 0
  private lookedMs = 0
  private heldUp = false
  private attempt = 0
  private looking: ReturnType<typeof setInterval> | undefined
  private retry: ReturnType<typeof setTimeout> | undefined

  constructor(
    private readonly url: string,
    private readonly events: StreamEvents,
  ) {}

  open(): void {
    this.lookedMs = performance.now()
    this.looking = setInterval(() => this.look(), LOOK_MS)
    this.dial()
  }

  close(): void {
    clearInterval(this.looking)
    clearTimeout(this.retry)
    this.drop()
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
    this.events.told(event, data)
  }

  private over(why: string): void {
    this.drop()
    this.retry = setTimeout(() => this.dial(), pause(this.attempt++, Math.random()))
    this.events.gone(why)
  }

  /** A dead link may take minutes to report its own close: nobody waits for that. */
  private drop(): void {
    const socket = this.socket
    this.socket = null
    if (socket === null) return
    socket.onmessage = socket.onclose = null
    socket.close()
  }

  private look(): void {
    const now = performance.now()
    const late = now - this.lookedMs > HELD_UP_MS
    // What came while the page was held up waits to be read; only a page that goes on so is taken at its word.
    const wait = late && !this.heldUp
    this.lookedMs = now
    this.heldUp = late
    const silent = now - this.heardMs
    if (wait || this.socket === null || silent < SILENT_MS) return
    this.events.silent(silent)
    if (silent >= DEAD_MS) this.over('')
  }
}
