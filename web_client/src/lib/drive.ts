/** Driving as a state machine: publish while held, one zero on release, then silence.
 *
 * It knows no DOM, no socket and no clock; the page feeds it inputs and ticks.
 */
import type { Twist } from './types'

export const PUBLISH_INTERVAL_MS = 66
/** A page that was frozen this long must not go on with what was held before. */
export const FROZEN_MS = 500

export type Source = 'joystick' | 'keys'
export type Phase = 'idle' | 'driving'

/** Why driving ended. All but `released` let go of every input: it has to be taken hold of again. */
export type StopReason =
  | 'released'
  | 'stop_button'
  | 'pointer_cancelled'
  | 'window_left'
  | 'page_hidden'
  | 'link_late'
  | 'link_closed'
  | 'page_frozen'
  | 'not_allowed'
  | 'topic_changed'

export interface Limits {
  /** Metres per second. */
  linear: number
  /** Radians per second. */
  angular: number
}

/** Where commands go. Returns false if nothing was sent; nothing is ever kept for later. */
export type Sender = (command: Twist) => boolean

/** What stands between the driver and the robot; null when nothing does. */
export type Obstacle = () => StopReason | null

interface Stick {
  /** -1 (right) to 1 (left). */
  turn: number
  /** -1 (back) to 1 (ahead). */
  ahead: number
}

export class Drive {
  private held = new Map<Source, Stick>()
  private phaseNow: Phase = 'idle'
  private publishedMs = -Infinity
  private tickedMs: number | null = null

  /**
   * @param send publishes a command at once, or says it can't
   * @param obstacle asked before every command
   * @param changed told of every change of phase and its reason
   */
  constructor(
    private readonly send: Sender,
    private readonly obstacle: Obstacle,
    private limits: Limits,
    private readonly changed: (phase: Phase, reason: StopReason | null) => void = () => {},
  ) {}

  get phase(): Phase {
    return this.phaseNow
  }

  setLimits(limits: Limits): void {
    this.limits = limits
  }

  /** Takes hold of an input; refused, with the reason, if something stands in the way. */
  grab(source: Source, nowMs: number): StopReason | null {
    const reason = this.obstacle()
    if (reason !== null) {
      this.stop(reason)
      return reason
    }
    this.held.set(source, { turn: 0, ahead: 0 })
    if (this.phaseNow === 'idle') {
      this.phaseNow = 'driving'
      this.tickedMs = nowMs
      this.changed('driving', null)
    }
    return null
  }

  /** Moves an input that is held; an input that isn't held is ignored. */
  steer(source: Source, turn: number, ahead: number, nowMs: number): void {
    if (!this.held.has(source)) return
    this.held.set(source, { turn: clamp(turn), ahead: clamp(ahead) })
    if (nowMs - this.publishedMs >= PUBLISH_INTERVAL_MS) this.tick(nowMs)
  }

  /** Lets go of an input; the last one ends driving with one zero. */
  release(source: Source): void {
    if (this.held.delete(source) && this.held.size === 0) this.end('released')
  }

  /** Ends driving with one zero and lets go of every input. Does nothing when idle. */
  stop(reason: StopReason): void {
    if (this.phaseNow === 'driving') this.end(reason)
  }

  /** The STOP button: a zero goes out whether driving or not. Returns whether it was sent. */
  stopNow(): boolean {
    if (this.phaseNow === 'driving') return this.end('stop_button')
    return this.send(ZERO)
  }

  /** Called often by the page; publishes when it is time to. */
  tick(nowMs: number): void {
    if (this.phaseNow === 'idle') return
    const gap = this.tickedMs === null ? 0 : nowMs - this.tickedMs
    this.tickedMs = nowMs
    const reason = gap > FROZEN_MS ? 'page_frozen' : this.obstacle()
    if (reason !== null) {
      this.stop(reason)
      return
    }
    if (nowMs - this.publishedMs < PUBLISH_INTERVAL_MS) return
    this.publishedMs = nowMs
    if (!this.send(this.command())) this.stop('link_closed')
  }

  private command(): Twist {
    // The hand on the joystick is more exact than the keys.
    const stick = this.held.get('joystick') ?? this.held.get('keys') ?? { turn: 0, ahead: 0 }
    return twist(stick.ahead * this.limits.linear, stick.turn * this.limits.angular)
  }

  private end(reason: StopReason): boolean {
    this.held.clear()
    this.phaseNow = 'idle'
    this.publishedMs = -Infinity
    this.tickedMs = null
    const sent = this.send(ZERO)
    this.changed('idle', reason)
    return sent
  }
}

function clamp(value: number): number {
  return Number.isFinite(value) ? Math.max(-1, Math.min(1, value)) : 0
}

/** A planar command.
 *
 * @param ahead metres per second along x
 * @param turn radians per second about z, left is positive
 */
export function twist(ahead: number, turn: number): Twist {
  return { linear: { x: ahead, y: 0, z: 0 }, angular: { x: 0, y: 0, z: turn } }
}

export const ZERO: Twist = twist(0, 0)

const REASONS: Partial<Record<StopReason, string>> = {
  pointer_cancelled: 'Stopped: the touch was taken over by the browser.',
  window_left: 'Stopped: the window lost the focus.',
  page_hidden: 'Stopped: the page was hidden.',
  link_late: 'Stopped: the link is late. Take hold again when it has recovered.',
  link_closed: 'Stopped: the connection was lost.',
  page_frozen: 'Stopped: the page stood still for too long.',
  topic_changed: 'Stopped: the command topic was changed.',
}

/** What to tell the driver about a stop, or null when it needs no words. */
export function stopWords(reason: StopReason): string | null {
  return REASONS[reason] ?? null
}
