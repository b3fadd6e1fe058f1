/** Watching a camera: what may be asked for, and the websocket its pictures come by (protocol/SPEC.md 1.8 and 2.6). */
import { pause } from './backoff'
import { type Ending, videoEnding } from './closing'
import { STALE_MS } from './meter'
import type { LinkState } from './ros'

export type Codec = 'jpeg' | 'h264'

export interface Camera {
  name: string
  /** Of its topic; empty for a camera without ROS. */
  type: string
}

/** What one pane shows. */
export interface Wish {
  /** Null: nobody has chosen yet. */
  camera: string | null
  /** Pixels; 0 is the camera's own. */
  width: number
  quality: number
  /** Most pictures per second; 0 is all there are. */
  fps: number
  /** Degrees, clockwise. */
  rotate: number
  codec: Codec
}

export interface PictureHeader {
  number: number
  /** Unix time at the robot, seconds. */
  stamp: number
  codec: string
  /** Whether it stands alone. */
  key: boolean
}

/** What the robot sends from now on. */
export interface Playing {
  width: number
  height: number
  quality: number
  /** 0 for all there are. */
  fps: number
  /** How far below what was asked for: 0 as asked, 1 the least there is. */
  reduced: number
  source_fps: number
}

// Few values, because viewers who want the same share a stream and its cost.
export const WIDTHS = [0, 1280, 640, 320]
export const QUALITIES = [95, 80, 60, 40, 20]
export const RATES = [0, 15, 5, 1]
export const ROTATIONS = [0, 90, 180, 270]
const CODECS: Codec[] = ['jpeg', 'h264']

export const MOST_PANES = 4
export const PLAIN: Wish = { camera: null, width: 0, quality: 80, fps: 0, rotate: 0, codec: 'jpeg' }

/** What was shown the last time, as far as it makes sense; at least one pane. */
export function restored(stored: unknown): Wish[] {
  const found = (Array.isArray(stored) ? stored : []).filter((each) => typeof each === 'object' && each !== null)
  const wishes = found.slice(0, MOST_PANES).map((each: Partial<Record<keyof Wish, unknown>>) => ({
    camera: typeof each.camera === 'string' ? each.camera : null,
    width: known(WIDTHS, each.width) ?? PLAIN.width,
    quality: known(QUALITIES, each.quality) ?? PLAIN.quality,
    fps: known(RATES, each.fps) ?? PLAIN.fps,
    rotate: known(ROTATIONS, each.rotate) ?? PLAIN.rotate,
    codec: known(CODECS, each.codec) ?? PLAIN.codec,
  }))
  return wishes.length > 0 ? wishes : [PLAIN]
}

function known<T>(values: T[], value: unknown): T | undefined {
  return values.find((each) => each === value)
}

/** The camera to show when nobody has chosen: one that costs the robot no encoding, and no depth picture.
 *
 * @param taken shown already; taken once more only when there is no other
 */
export function pickCamera(cameras: Camera[], taken: string[] = []): string | null {
  const rank = ({ name, type }: Camera) =>
    (taken.includes(name) ? 4 : 0) + (/depth/i.test(name) ? 2 : 0) + (type.endsWith('/CompressedImage') ? 0 : 1)
  const sorted = [...cameras].sort(
    (a, b) => rank(a) - rank(b) || a.name.length - b.name.length || a.name.localeCompare(b.name),
  )
  return sorted[0]?.name ?? null
}

/** A wish as the query of an address; what is as usual is left out. */
export function parameters(camera: string, wish: Omit<Wish, 'camera'>): string {
  const query = new URLSearchParams({ topic: camera })
  for (const name of ['width', 'quality', 'fps', 'rotate', 'codec'] as const) {
    if (wish[name] !== PLAIN[name]) query.set(name, String(wish[name]))
  }
  return query.toString()
}

/** How long after a picture the next one is missed, in milliseconds: a slow stream is not a broken one. */
export function missedAfter(wanted: number, playing: Pick<Playing, 'fps' | 'source_fps'> | null): number {
  const rates = [wanted, playing?.fps ?? 0, playing?.source_fps ?? 0].filter((rate) => rate > 0)
  return Math.max(STALE_MS, 2500 / Math.min(...rates))
}

/** The robot's clock may differ from the relay's by so much without anybody minding. */
const CLOCK_SLACK_MS = 100
const OLDEST_MS = 10_000

/** How old a picture is, in milliseconds; null when nobody can tell.
 *
 * @param stamp Unix time at the robot, seconds
 * @param unixMs the time now by the relay's clock; null when it is not known
 */
export function age(stamp: number, unixMs: number | null): number | null {
  if (unixMs === null) return null
  const found = unixMs - stamp * 1000
  // The relay passes on no such picture: what is wrong is the robot's clock.
  return found < -CLOCK_SLACK_MS || found > OLDEST_MS ? null : Math.max(0, found)
}

/** What a snapshot is called: robot, camera and the picture's time in UTC.
 *
 * @param stamp Unix time, seconds
 */
export function fileName(robot: string, camera: string, stamp: number): string {
  const time = new Date(stamp * 1000).toISOString().replaceAll(/[:.]/g, '-')
  return `${[robot, camera, time].map((part) => part.replaceAll(/[^\w-]+/g, '-').replaceAll(/^-+|-+$/g, '')).join('-')}.jpg`
}

/** A connection on which nothing comes for so long is dialled anew; the relay ends one without pictures earlier. */
export const SILENT_MS = 15_000

export type Close = Pick<CloseEvent, 'code' | 'reason'>

export interface VideoEvents {
  /** @param close when it is one: its code, and the relay's own words */
  state(state: LinkState, why: Ending | null, close: Close | null): void
  playing(playing: Playing): void
  /** Resolves when the picture is on the screen or given up; the next one comes after that. */
  picture(header: PictureHeader, body: ArrayBuffer): Promise<void>
}

export class VideoLink {
  private socket: WebSocket | null = null
  private stateNow: LinkState = 'connecting'
  private attempt = 0
  private retry: ReturnType<typeof setTimeout> | undefined
  private silence: ReturnType<typeof setTimeout> | undefined

  constructor(
    private readonly url: string,
    private readonly events: VideoEvents,
    private readonly dial: (url: string) => WebSocket = (url) => new WebSocket(url),
  ) {}

  open(): void {
    clearTimeout(this.retry)
    this.become('connecting')
    const socket = this.dial(this.url)
    let header: PictureHeader | null = null
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
        if (message.op === 'picture') header = message as unknown as PictureHeader
        else if (message.op === 'playing') this.events.playing(message as unknown as Playing)
      } else if (header !== null) {
        void this.take(socket, header, data)
        header = null
      }
    }
    this.listen(socket)
  }

  /** Tries at once, whether it waits for the next attempt or has given up. */
  retryNow(): void {
    if (this.stateNow === 'waiting' || this.stateNow === 'ended') this.open()
  }

  /** No event comes after this. */
  close(): void {
    const socket = this.socket
    this.socket = null
    clearTimeout(this.retry)
    clearTimeout(this.silence)
    socket?.close(1000)
  }

  private async take(socket: WebSocket, header: PictureHeader, body: ArrayBuffer): Promise<void> {
    // Not at `open`: a refused handshake is accepted, then closed, and would be tried again without a pause.
    this.attempt = 0
    await this.events.picture(header, body)
    if (socket === this.socket) socket.send(JSON.stringify({ op: 'took', number: header.number }))
  }

  /** A dead connection may take minutes to report its own end. */
  private listen(socket: WebSocket): void {
    clearTimeout(this.silence)
    this.silence = setTimeout(() => {
      socket.close()
      this.closed(socket, { code: 1006, reason: '' })
    }, SILENT_MS)
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
