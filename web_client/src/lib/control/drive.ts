/** Driving as a state machine: a zero first, publish while held, one zero on release, then silence.
 *
 * It knows no DOM, no socket and no clock; the page feeds it inputs and ticks.
 */
import type { Twist } from '../ros/messages'

export const PUBLISH_INTERVAL_MS = 66
/** After a page was frozen this long, inputs must be pressed again. */
export const FROZEN_MS = 500

/** The most exact input first: it wins while several are held. */
export const SOURCES = ['joystick', 'tilt', 'gamepad', 'keys'] as const
export type Source = (typeof SOURCES)[number]
export type Phase = 'idle' | 'driving'

/** Reasons for the end of driving, with the message; null when none is needed.
 *
 * After all but `released` every input must be pressed again.
 */
export const DEADMAN_EVENTS = {
  released: null,
  stop_button: null,
  not_allowed: null,
  control_lost: null,
  robot_stopped: 'Stopped: the robot was stopped.',
  pointer_cancelled: 'Stopped: the browser took over the touch.',
  capture_lost: 'Stopped: the browser took the pointer away.',
  several_fingers: 'Stopped: more than one finger was on the screen.',
  menu_opened: 'Stopped: a menu was opened.',
  dialog_opened: 'Stopped: a dialog was opened.',
  field_entered: 'Stopped: a field or a list has the keyboard focus.',
  key_silent: 'Stopped: no more key events. Press the key again.',
  drag_began: 'Stopped: an element of the page was dragged.',
  view_changed: 'Stopped: full screen was switched on or off.',
  page_printed: 'Stopped: the page is printed.',
  window_left: 'Stopped: the window lost the focus.',
  page_hidden: 'Stopped: the page was hidden.',
  page_frozen: 'Stopped: the page was not responding.',
  gamepad_gone: 'Stopped: the gamepad was disconnected.',
  tilt_silent: 'Stopped: the phone no longer reports its orientation.',
  link_late: 'Stopped: the link is slow. Start again when it has recovered.',
  robot_late: 'Stopped: the robot responds slowly. Start again when it has recovered.',
  link_closed: 'Stopped: the connection was lost.',
  topic_changed: 'Stopped: the command topic was changed.',
} as const

export type StopReason = keyof typeof DEADMAN_EVENTS

export interface Limits {
  /** Metres per second. */
  linear: number
  /** Radians per second. */
  angular: number
}

/** Sends a command. Returns false if it was not sent; it is never sent later. */
export type Sender = (command: Twist) => boolean

/** Why driving is not possible; null when it is. */
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
   * @param send publishes a command at once, or returns false
   * @param obstacle called before every command
   * @param limits called for every command
   * @param changed called on every change of phase with its reason
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

  /** Starts driving by an input; refused with the reason if driving is not possible. */
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
      // Start at zero: the robot obeys only after the controls were released (SPEC 2.5).
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

  /** Releases an input; the last one ends driving with one zero. */
  release(source: Source): void {
    if (this.held.delete(source) && this.held.size === 0) this.end('released')
  }

  /** An input failed: driving ends if it was in use. */
  lose(source: Source, reason: StopReason): void {
    if (this.held.has(source)) this.end(reason)
  }

  isHeld(source: Source): boolean {
    return this.held.has(source)
  }

  /** Ends driving with one zero and releases every input. Does nothing when idle. */
  stop(reason: StopReason): void {
    if (this.phaseNow === 'driving') this.end(reason)
  }

  /** Called often by the page; publishes when a command is due. */
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

/** Message about a stop, or null when none is needed. */
export function stopWords(reason: StopReason): string | null {
  return DEADMAN_EVENTS[reason]
}
