/** Viewing a camera: parameters of the stream, and its websocket (SPEC 1.8 and 2.6). */
import { pause } from '../api/backoff'
import { type Ending, videoEnding } from '../api/closeCodes'
import type { Camera } from '../api/types'
import { milliseconds, moment } from '../format'
import type { PictureHeader, Playing } from '../ros/messages'
import { STALE_MS } from '../ros/rateMeter'
import type { LinkState } from '../ros/robotLink'

export type Codec = 'jpeg' | 'h264'

/** Settings of one pane. */
export interface StreamRequest {
  /** Null until the user chooses. */
  camera: string | null
  /** Pixels; 0 is the camera's own size. */
  width: number
  quality: number
  /** Most frames per second; 0 is all. */
  fps: number
  /** Degrees, clockwise. */
  rotate: number
  codec: Codec
}

/** The parameters that differ, in words. */
export function insteadWords(instead: Record<string, unknown>): string {
  const words = { width: 'width', height: 'height', quality: 'quality', fps: 'frames per second' }
  const known = Object.entries(words).filter(([name]) => name in instead)
  // 0 means the camera’s own value.
  const differences = known.map(([name, word]) => `${word} ${instead[name] === 0 ? 'the camera’s own' : String(instead[name])}`)
  const form = differences.length > 0 ? ` (${differences.join(', ')})` : ''
  return `The robot is at its limit of streams. This is a stream that others requested${form}, until another one ends.`
}

// Few values, because viewers with equal settings share a stream and its cost.
export const WIDTHS = [0, 1280, 640, 320]
export const QUALITIES = [95, 80, 60, 40, 20]
export const RATES = [0, 15, 5, 1]
export const ROTATIONS = [0, 90, 180, 270]
const CODECS: Codec[] = ['jpeg', 'h264']

export const MOST_PANES = 4
export const PLAIN: StreamRequest = { camera: null, width: 0, quality: 80, fps: 0, rotate: 0, codec: 'jpeg' }

/** The panes of the last visit, as far as valid; at least one. */
export function restored(stored: unknown): StreamRequest[] {
  const found = (Array.isArray(stored) ? stored : []).filter((each) => typeof each === 'object' && each !== null)
  const requests = found.slice(0, MOST_PANES).map((each: Partial<Record<keyof StreamRequest, unknown>>) => ({
    camera: typeof each.camera === 'string' ? each.camera : null,
    width: known(WIDTHS, each.width) ?? PLAIN.width,
    quality: known(QUALITIES, each.quality) ?? PLAIN.quality,
    fps: known(RATES, each.fps) ?? PLAIN.fps,
    rotate: known(ROTATIONS, each.rotate) ?? PLAIN.rotate,
    codec: known(CODECS, each.codec) ?? PLAIN.codec,
  }))
  return requests.length > 0 ? requests : [PLAIN]
}

function known<T>(values: T[], value: unknown): T | undefined {
  return values.find((each) => each === value)
}

/** The default camera: one that needs no encoding on the robot, and no depth image.
 *
 * @param taken cameras that are shown already; used again only if there is no other
 */
export function pickCamera(cameras: Pick<Camera, 'name' | 'type'>[], taken: string[] = []): string | null {
  const rank = ({ name, type }: Pick<Camera, 'name' | 'type'>) =>
    (taken.includes(name) ? 4 : 0) + (/depth/i.test(name) ? 2 : 0) + (type.endsWith('/CompressedImage') ? 0 : 1)
  const sorted = [...cameras].sort(
    (a, b) => rank(a) - rank(b) || a.name.length - b.name.length || a.name.localeCompare(b.name),
  )
  return sorted[0]?.name ?? null
}

/** The settings as URL query, without default values. */
export function parameters(camera: string, request: Omit<StreamRequest, 'camera'>): string {
  const query = new URLSearchParams({ topic: camera })
  for (const name of ['width', 'quality', 'fps', 'rotate', 'codec'] as const) {
    if (request[name] !== PLAIN[name]) query.set(name, String(request[name]))
  }
  return query.toString()
}

/** Time after a frame from which the next one is overdue, milliseconds. It depends on the rate, since a slow stream is not broken.
 *
 * @param previousFps frames per second that the camera sent before, 0: unknown
 */
export function missedAfter(
  wanted: number,
  playing: Pick<Playing, 'fps' | 'source_fps'> | null,
  previousFps: number = 0,
): number {
  const rates = [wanted, playing?.fps ?? 0, playing?.source_fps || previousFps].filter((rate) => rate > 0)
  return Math.max(STALE_MS, 2500 / Math.min(...rates))
}

/** Difference of the robot's clock from the relay's that is ignored, milliseconds. */
const CLOCK_SLACK_MS = 100
const OLDEST_MS = 10_000
/** Time for which robot and relay store a frame if its rate is unknown, 30 s each; milliseconds. */
const KEPT_MS = 60_000
/** Otherwise both together store it for 3.5 frame intervals, of which {@link missedAfter} waits for 2.5. */
const KEPT_MISSED = 1.5
/** Ages from here on grow while the frame is shown; a smaller one is the delay of the frame. Milliseconds. */
const GROWS_MS = 2000

/** A frame on the screen. Times by the page's clock, milliseconds. */
export interface Drawn extends Pick<PictureHeader, 'stamp' | 'kept'> {
  drawnMs: number
}

/** Age of a frame when it was drawn, milliseconds; null if unknown.
 *
 * @param unixMs the relay's time at that moment; null if unknown
 */
export function age(picture: Pick<PictureHeader, 'stamp' | 'kept'>, unixMs: number | null): number | null {
  if (unixMs === null) return null
  const found = unixMs - picture.stamp * 1000
  // The relay drops live frames of this age, so the robot's clock must be wrong.
  return found < -CLOCK_SLACK_MS || (found > OLDEST_MS && !picture.kept) ? null : Math.max(0, found)
}

/** Time without a newer frame, milliseconds.
 *
 * @param unixMs the relay's present time, or the best estimate of it
 */
export function silence(picture: Drawn, nowMs: number, unixMs: number): number {
  const shownMs = nowMs - picture.drawnMs
  return picture.kept ? Math.max(shownMs, unixMs - picture.stamp * 1000) : shownMs
}

/** Message about a frame after which the next one is overdue.
 *
 * @param unixMs the relay's present time, or the best estimate of it
 */
export function sinceWhen(picture: Drawn, nowMs: number, unixMs: number, missedMs: number): string {
  const silentMs = silence(picture, nowMs, unixMs)
  const foundMs = silentMs - (nowMs - picture.drawnMs)
  // A latched frame, so the camera may be fine; or the robot's clock was never set.
  if (foundMs > Math.max(KEPT_MS, KEPT_MISSED * missedMs)) {
    return `Frame of ${moment(picture.stamp, unixMs / 1000)}, by the robot’s clock`
  }
  return `No frame for ${span(silentMs)}`
}

/** The age of a frame in words.
 *
 * @param ageMs its age when it was drawn; null if unknown
 * @param shownMs time for which it has been shown
 */
export function ageWords(ageMs: number | null, shownMs: number): string {
  if (ageMs === null) return 'age unknown'
  return `${ageMs + shownMs < GROWS_MS ? milliseconds(ageMs) : span(ageMs + shownMs)} old`
}

function span(ms: number): string {
  const seconds = Math.floor(ms / 1000)
  if (seconds < 120) return `${seconds} s`
  return seconds < 7200 ? `${Math.floor(seconds / 60)} min` : `${Math.floor(seconds / 3600)} h`
}

/** File name of a snapshot: robot, camera and the frame's time in UTC.
 *
 * @param stamp Unix time, seconds
 */
export function fileName(robot: string, camera: string, stamp: number): string {
  const time = new Date(stamp * 1000).toISOString().replaceAll(/[:.]/g, '-')
  return `${[robot, camera, time].map((part) => part.replaceAll(/[^\w-]+/g, '-').replaceAll(/^-+|-+$/g, '')).join('-')}.jpg`
}

/** A connection without data for this time is opened again, milliseconds. The relay closes one without frames earlier. */
export const SILENT_MS = 15_000
/** Longest time for which the relay waits for a first frame, milliseconds. */
const MOST_MISSED_MS = 120_000
const SLACK_MS = 5000

/** Longest silence of a connection, milliseconds.
 *
 * @param missedMs time after a frame from which the next one is overdue
 */
export function silentAfter(missedMs: number): number {
  return Math.max(SILENT_MS, Math.min(missedMs, MOST_MISSED_MS) + SLACK_MS)
}

export type Close = Pick<CloseEvent, 'code' | 'reason'>

export interface VideoEvents {
  /** @param close close code and reason, if the websocket was closed */
  state(state: LinkState, why: Ending | null, close: Close | null): void
  playing(playing: Playing): void
  /** Resolves when the frame is shown or dropped; the next one comes after that. */
  picture(picture: PictureHeader, body: ArrayBuffer): Promise<void>
}

export class VideoLink {
  private socket: WebSocket | null = null
  private stateNow: LinkState = 'connecting'
  private attempt = 0
  private retry: ReturnType<typeof setTimeout> | undefined
  private silence: ReturnType<typeof setTimeout> | undefined

  /** @param silentMs longest silence, called after each message */
  constructor(
    private readonly url: string,
    private readonly events: VideoEvents,
    private readonly silentMs: () => number = () => SILENT_MS,
    private readonly dial: (url: string) => WebSocket = (url) => new WebSocket(url),
  ) {}

  open(): void {
    clearTimeout(this.retry)
    this.become('connecting')
    const socket = this.dial(this.url)
    let header: PictureHeader | null = null
    let before = { number: Infinity, stamp: 0 }
    socket.binaryType = 'arraybuffer'
    this.socket = socket
    socket.onopen = () => {
      if (socket === this.socket) this.become('open')
    }
    socket.onclose = (event) => this.closed(socket, event)
    socket.onmessage = ({ data }: MessageEvent<string | ArrayBuffer>) => {
      if (socket !== this.socket) return
      this.listen(socket)
      if (typeof data === 'string') {
        const message = JSON.parse(data) as { op: string }
        if (message.op === 'frame') {
          header = message as unknown as PictureHeader
          // The first frame here, or of a stream that the robot has started again (numbers begin again), or the same frame again.
          header.kept = header.number <= before.number || header.stamp <= before.stamp
          before = header
        } else if (message.op === 'stream_status') this.events.playing(message as unknown as Playing)
      } else if (header !== null) {
        void this.take(socket, header, data)
        header = null
      }
    }
    this.listen(socket)
  }

  /** Connects at once, even after it has given up. */
  retryNow(): void {
    if (this.stateNow === 'waiting' || this.stateNow === 'ended') this.open()
  }

  /** Closes it; no event comes afterwards. */
  close(): void {
    const socket = this.socket
    this.socket = null
    clearTimeout(this.retry)
    clearTimeout(this.silence)
    socket?.close(1000)
  }

  private async take(socket: WebSocket, picture: PictureHeader, body: ArrayBuffer): Promise<void> {
    // Not at `open`: a refused websocket is opened and then closed, and would be retried without a pause.
    this.attempt = 0
    await this.events.picture(picture, body)
    if (socket === this.socket) socket.send(JSON.stringify({ op: 'frame_ack', number: picture.number }))
  }

  /** Drops a connection without waiting for its end, which a dead one may report minutes later. */
  private listen(socket: WebSocket): void {
    clearTimeout(this.silence)
    this.silence = setTimeout(() => {
      socket.close()
      this.closed(socket, { code: 1006, reason: '' })
    }, this.silentMs())
  }

  private closed(socket: WebSocket, close: Close): void {
    if (socket !== this.socket) return
    this.socket = null
    clearTimeout(this.silence)
    const why = videoEnding(close.code, close.reason)
    this.become(why.after === 'retry' ? 'waiting' : 'ended', why, close)
    if (why.after === 'retry') this.retry = setTimeout(() => this.open(), pause(this.attempt++, Math.random()))
  }

  private become(state: LinkState, why: Ending | null = null, close: Close | null = null): void {
    this.stateNow = state
    this.events.state(state, why, close)
  }
}
