/**
 * A gamepad as an input. It drives only while a shoulder button, the deadman switch, is held.
 *
 * Only the standard layout says which buttons these are. A pad with another layout drives after its user has chosen a
 * button.
 */

/** Deflection below which a stick counts as centred, since worn sticks do not return completely. */
export const DEAD_ZONE = 0.15

/** Shoulder buttons and triggers of the standard layout (Gamepad, W3C, section 10). */
const SWITCHES = [4, 5, 6, 7]
const HORIZONTAL = 0
const VERTICAL = 1

/** The used part of the browser's `Gamepad`. */
export interface Pad {
  index: number
  id: string
  connected: boolean
  /** `standard`, or empty where the browser does not know the layout. */
  mapping: string
  buttons: readonly { pressed: boolean }[]
  axes: readonly number[]
}

export interface Stick {
  /** -1 (right) to 1 (left). */
  turn: number
  /** -1 (back) to 1 (ahead). */
  ahead: number
}

/** The drive that the gamepad controls. */
export interface Wheel {
  /** Starts driving; false when it is not possible. */
  grab(): boolean
  steer(turn: number, ahead: number): void
  release(): void
  gone(): void
}

/** The left stick with a deadzone, scaled to the full range. */
export function stickOf(pad: Pad): Stick {
  const [x, y] = [pad.axes[HORIZONTAL] ?? 0, pad.axes[VERTICAL] ?? 0]
  const far = Math.hypot(x, y)
  if (!Number.isFinite(far) || far < DEAD_ZONE) return { turn: 0, ahead: 0 }
  const scale = Math.min(1, (far - DEAD_ZONE) / (1 - DEAD_ZONE)) / far
  return { turn: -x * scale + 0, ahead: -y * scale + 0 }
}

/** Chosen buttons of pads without the standard layout, by the pads' ids. */
export type ChosenButtons = Record<string, number>

/**
 * - `unknown`: all pads lack the standard layout, and none has a chosen button
 * - `choosing`: waits for the button
 * - `off-centre`: the same; a button was pressed while the stick was not centred
 */
export type GamepadState = 'none' | 'unknown' | 'choosing' | 'off-centre' | 'ready' | 'held'

/** Reads the gamepads and reports changes. */
export class GamepadDriver {
  /** The pad whose switch was pressed. */
  private held: number | null = null
  /** Deadman switches that were seen released. One that is pressed from the beginning does not count. */
  private free = new Set<number>()
  /** While a button is chosen: which buttons of each pad were seen released. */
  private candidates: Map<number, Set<number>> | null = null
  private offCentre = false

  /** @param chosen buttons that were chosen before; a choice is added */
  constructor(
    private readonly wheel: Wheel,
    readonly chosen: ChosenButtons = {},
  ) {}

  /** The next button that is pressed on a pad without the standard layout becomes its deadman switch. */
  choose(): void {
    if (this.held !== null) this.wheel.release()
    this.requireRelease()
    this.candidates = new Map()
    this.offCentre = false
  }

  cancelChoice(): void {
    this.candidates = null
  }

  /** Reads the gamepads once.
   *
   * @param pads result of `navigator.getGamepads()`
   * @param mayHold whether a switch may count now: this page has control and the focus
   */
  poll(pads: readonly (Pad | null)[], mayHold: boolean): GamepadState {
    const there = pads.filter((pad): pad is Pad => pad !== null && pad.connected)
    if (this.candidates !== null) return this.findChoice(there, this.candidates)
    if (!mayHold) return this.rest(there)
    if (this.held !== null) this.follow(there.find((pad) => pad.index === this.held))
    else for (const pad of there) this.consider(pad)
    return this.held !== null ? 'held' : this.resting(there)
  }

  /** Whether a pad is there whose button is chosen by its user. */
  needsChoice(pads: readonly (Pad | null)[]): boolean {
    return pads.some((pad) => pad !== null && pad.connected && pad.mapping !== 'standard')
  }

  private findChoice(there: Pad[], candidates: Map<number, Set<number>>): GamepadState {
    for (const pad of there) {
      if (pad.mapping === 'standard') continue
      const released = candidates.get(pad.index) ?? new Set<number>()
      candidates.set(pad.index, released)
      for (const [button, { pressed }] of pad.buttons.entries()) {
        if (!pressed) released.add(button)
        else if (released.delete(button)) {
          // A stick that does not rest in its middle is none: such axes would drive at once.
          const { turn, ahead } = stickOf(pad)
          this.offCentre = turn !== 0 || ahead !== 0 || pad.axes.length < 2
          if (this.offCentre) continue
          this.chosen[pad.id] = button
          this.candidates = null
          return this.resting(there)
        }
      }
    }
    return this.offCentre ? 'off-centre' : 'choosing'
  }

  private resting(there: Pad[]): GamepadState {
    if (there.length === 0) return 'none'
    return there.some((pad) => this.switchesOf(pad).length > 0) ? 'ready' : 'unknown'
  }

  private switchesOf(pad: Pad): readonly number[] {
    if (pad.mapping === 'standard') return SWITCHES
    const button = Object.hasOwn(this.chosen, pad.id) ? this.chosen[pad.id] : undefined
    return button === undefined ? [] : [button]
  }

  private isPressed(pad: Pad): boolean {
    return this.switchesOf(pad).some((button) => pad.buttons[button]?.pressed === true)
  }

  /** Driving ended for another reason: the button must be released before it counts again. */
  requireRelease(): void {
    this.held = null
    this.free.clear()
  }

  private rest(there: Pad[]): GamepadState {
    if (this.held !== null) this.wheel.release()
    this.requireRelease()
    return this.resting(there)
  }

  private follow(pad: Pad | undefined): void {
    if (pad === undefined) {
      this.requireRelease()
      this.wheel.gone()
    } else if (!this.isPressed(pad)) {
      this.held = null
      this.free.add(pad.index)
      this.wheel.release()
    } else {
      const { turn, ahead } = stickOf(pad)
      this.wheel.steer(turn, ahead)
    }
  }

  private consider(pad: Pad): void {
    if (!this.isPressed(pad)) {
      this.free.add(pad.index)
    } else if (this.held === null && this.free.delete(pad.index) && this.wheel.grab()) {
      this.held = pad.index
      this.follow(pad)
    }
  }
}
