/** Watching a camera: what may be asked for, and the websocket its pictures come by (protocol/SPEC.md 1.8 and 2.6). */
import { pause } from './backoff'
import { type Ending, videoEnding } from './closing'
import { milliseconds, moment } from './format'
import { STALE_MS } from './meter'
import type { LinkState } from './ros'

export type Codec = 'jpeg' | 'h264'

export interface Camera {
  name: string
  /** Of its topic; empty for a camera without ROS. */
  type: string
  /** Pictures per second, as they came when somebody watched; null: not known. */
  fps?: number | null
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
  /** Whether it may have been kept before it was sent, so that its stamp alone tells how old it is; told by the link. */
  kept: boolean
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
  /** Of another form that is shown in the place of the one asked for: in what it differs; null: it is as asked. */
  instead?: Record<string, unknown> | null
  /** Why no picture has come for a while though the camera gives some; empty while all is well. */
  trouble?: string
}

/** Another form of the camera in words. */
export function insteadWords(instead: Record<string, unknown>): string {
  const words = { width: 'width', height: 'height', quality: 'quality', fps: 'pictures per second' }
  const known = Object.entries(words).filter(([name]) => name in instead)
  // What is as the camera has it is told as 0.
  const told = known.map(([name, word]) => `${word} ${instead[name] === 0 ? 'the camera’s own' : String(instead[name])}`)
  const form = told.length > 0 ? ` (${told.join(', ')})` : ''
  return `The robot shows as many streams as it can. This is one that others asked for${form}, until there is a place.`
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

/** How long after a picture the next one is missed, in milliseconds: a slow stream is not a broken one.
 *
 * @param told pictures per second the camera gave before, 0: not known
 */
export function missedAfter(
  wanted: number,
  playing: Pick<Playing, 'fps' | 'source_fps'> | null,
  told: number = 0,
): number {
  const rates = [wanted, playing?.fps ?? 0, playing?.source_fps || told].filter((rate) => rate > 0)
  return Math.max(STALE_MS, 2500 / Math.min(...rates))
}

/** The robot's clock may differ from the relay's by so much without anybody minding. */
const CLOCK_SLACK_MS = 100
const OLDEST_MS = 10_000
/** Robot and relay keep a picture so long where they don't know when the next one is due, 30 s each. */
const KEPT_MS = 60_000
/** Else, together, until 3.5 pictures' time have passed, of which {@link missedAfter} waits for 2.5. */
const KEPT_MISSED = 1.5
/** From here on an age grows while one looks at it; below, it is how late the picture came. */
const GROWS_MS = 2000

/** A picture on the screen. Moments are of the page's clock, in milliseconds. */
export interface Drawn extends Pick<PictureHeader, 'stamp' | 'kept'> {
  drawnMs: number
}

/** How old a picture was as it was drawn, in milliseconds; null when nobody can tell.
 *
 * @param unixMs the relay's time then; null when it is not known
 */
export function age(picture: Pick<PictureHeader, 'stamp' | 'kept'>, unixMs: number | null): number | null {
  if (unixMs === null) return null
  const found = unixMs - picture.stamp * 1000
  // Of those that come as they are made the relay passes on none so old: what is wrong is the robot's clock.
  return found < -CLOCK_SLACK_MS || (found > OLDEST_MS && !picture.kept) ? null : Math.max(0, found)
}

/** For how long there has been no newer picture, in milliseconds.
 *
 * @param unixMs the relay's time now, or the nearest there is to it
 */
export function silence(picture: Drawn, nowMs: number, unixMs: number): number {
  const shownMs = nowMs - picture.drawnMs
  return picture.kept ? Math.max(shownMs, unixMs - picture.stamp * 1000) : shownMs
}

/** What is said of a picture after which the next one is missed.
 *
 * @param unixMs the relay's time now, or the nearest there is to it
 */
export function sinceWhen(picture: Drawn, nowMs: number, unixMs: number, missedMs: number): string {
  const silentMs = silence(picture, nowMs, unixMs)
  const foundMs = silentMs - (nowMs - picture.drawnMs)
  // Its publisher keeps it, and nothing need be wrong with the camera; or the robot's clock was never set.
  if (foundMs > Math.max(KEPT_MS, KEPT_MISSED * missedMs)) {
    return `Picture of ${moment(picture.stamp, unixMs / 1000)}, by the robot’s clock`
  }
  return `No picture since ${span(silentMs)}`
}

/** The age of a picture in words.
 *
 * @param ageMs as it was drawn; null when nobody can tell
 * @param shownMs for how long it has been shown
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
/** So long the relay waits for the first picture of the slowest camera. */
const MOST_MISSED_MS = 120_000
const SLACK_MS = 5000

/** How long nothing may come, in milliseconds.
 *
 * @param missedMs how long after a picture the next one is missed
 */
export function silentAfter(missedMs: number): number {
  return Math.max(SILENT_MS, Math.min(missedMs, MOST_MISSED_MS) + SLACK_MS)
}

export type Close = Pick<CloseEvent, 'code' | 'reason'>

export interface VideoEvents {
  /** @param close when it is one: its code, and the relay's own words */
  state(state: LinkState, why: Ending | null, close: Close | null): void
  playing(playing: Playing): void
  /** Resolves when the picture is on the screen or given up; the next one comes after that. */
  picture(picture: PictureHeader, body: ArrayBuffer): Promise<void>
}

export class VideoLink {
  private socket: WebSocket | null = null
  private stateNow: LinkState = 'connecting'
  private attempt = 0
  private retry: ReturnType<typeof setTimeout> | undefined
  private silence: ReturnType<typeof setTimeout> | undefined

  /** @param silentMs how long nothing may come, asked whenever something has come */
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
        if (message.op === 'picture') {
          header = message as unknown as PictureHeader
          // The first for us, or for the relay (what the robot begins anew it counts anew), or the same once more.
          header.kept = header.number <= before.number || header.stamp <= before.stamp
          before = header
        } else if (message.op === 'playing') this.events.playing(message as unknown as Playing)
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

  private async take(socket: WebSocket, picture: PictureHeader, body: ArrayBuffer): Promise<void> {
    // Not at `open`: a refused handshake is accepted, then closed, and would be tried again without a pause.
    this.attempt = 0
    await this.events.picture(picture, body)
    if (socket === this.socket) socket.send(JSON.stringify({ op: 'took', number: picture.number }))
  }

  /** A dead connection may take minutes to report its own end. */
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
