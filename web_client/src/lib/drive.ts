/** Driving as a state machine: a zero first, publish while held, one zero on release, then silence.
 *
 * It knows no DOM, no socket and no clock; the page feeds it inputs and ticks.
 */
import type { Twist } from './types'

export const PUBLISH_INTERVAL_MS = 66
/** A page that was frozen this long must not go on with what was held before. */
export const FROZEN_MS = 500

/** The most exact one first: when several are held it is obeyed. */
export const SOURCES = ['joystick', 'tilt', 'gamepad', 'keys'] as const
export type Source = (typeof SOURCES)[number]
export type Phase = 'idle' | 'driving'

/** Every way driving ends, and what the driver is told of it; null when it needs no words, or others find them.
 *
 * All but `released` let go of every input: it has to be taken hold of again.
 */
export const LETTING_GO = {
  released: null,
  stop_button: null,
  not_allowed: null,
  control_lost: null,
  robot_stopped: 'Stopped: the robot was stopped.',
  pointer_cancelled: 'Stopped: the touch was taken over by the browser.',
  capture_lost: 'Stopped: the browser took the pointer away.',
  several_fingers: 'Stopped: more than one finger was on the screen.',
  menu_opened: 'Stopped: a menu was opened.',
  dialog_opened: 'Stopped: a dialog was opened.',
  field_entered: 'Stopped: a field or a list took the keys.',
  key_silent: 'Stopped: the key is no longer told of. Press it again.',
  drag_began: 'Stopped: something on the page was dragged away.',
  view_changed: 'Stopped: the page was switched to the whole screen, or back.',
  page_printed: 'Stopped: the page is printed.',
  window_left: 'Stopped: the window lost the focus.',
  page_hidden: 'Stopped: the page was hidden.',
  page_frozen: 'Stopped: the page stood still for too long.',
  gamepad_gone: 'Stopped: the gamepad is gone.',
  tilt_silent: 'Stopped: the phone no longer tells how it is held.',
  link_late: 'Stopped: the link is late. Take hold again when it has recovered.',
  robot_late: 'Stopped: the robot is late. Take hold again when it has recovered.',
  link_closed: 'Stopped: the connection was lost.',
  topic_changed: 'Stopped: the command topic was changed.',
} as const

export type StopReason = keyof typeof LETTING_GO

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
   * @param limits asked for every command
   * @param changed told of every change of phase and its reason
   */
  constructor(
    private readonly send: Sender,
    private readonly obstacle: Obstacle,
    private readonly limits: () => Limits,
    private readonly changed: (phase: Phase, reason: StopReason | null) => void = () => {},
  ) {}

  get phase(): Phase {
    return this.phaseNow
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
      // The hand begins in the middle: a robot follows only who has let go before (protocol/SPEC.md 2.5).
      this.send(ZERO)
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

  /** An input failed in the hand: driving ends if it was held. */
  lose(source: Source, reason: StopReason): void {
    if (this.held.has(source)) this.end(reason)
  }

  isHeld(source: Source): boolean {
    return this.held.has(source)
  }

  /** Ends driving with one zero and lets go of every input. Does nothing when idle. */
  stop(reason: StopReason): void {
    if (this.phaseNow === 'driving') this.end(reason)
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
    const source = SOURCES.find((each) => this.held.has(each))
    const stick = (source && this.held.get(source)) ?? { turn: 0, ahead: 0 }
    const { linear, angular } = this.limits()
    return twist(stick.ahead * linear, stick.turn * angular)
  }

  private end(reason: StopReason): void {
    this.held.clear()
    this.phaseNow = 'idle'
    this.publishedMs = -Infinity
    this.tickedMs = null
    this.send(ZERO)
    this.changed('idle', reason)
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

/** What to tell the driver about a stop, or null when it needs no words. */
export function stopWords(reason: StopReason): string | null {
  return LETTING_GO[reason]
}
