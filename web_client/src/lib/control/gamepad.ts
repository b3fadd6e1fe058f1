/** A gamepad as an input. It drives only while a shoulder button, the deadman switch, is held. */

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

function isPressed(pad: Pad): boolean {
  return SWITCHES.some((button) => pad.buttons[button]?.pressed === true)
}

export type GamepadState = 'none' | 'ready' | 'held'

/** Reads the gamepads and reports changes. */
export class GamepadDriver {
  /** The pad whose switch was pressed. */
  private held: number | null = null
  /** Deadman switches that were seen released. One that is pressed from the beginning does not count. */
  private free = new Set<number>()

  constructor(private readonly wheel: Wheel) {}

  /** Reads the gamepads once.
   *
   * @param pads result of `navigator.getGamepads()`
   * @param mayHold whether a switch may count now: this page has control and the focus
   */
  poll(pads: readonly (Pad | null)[], mayHold: boolean): GamepadState {
    const there = pads.filter((pad): pad is Pad => pad !== null && pad.connected)
    if (!mayHold) return this.rest(there)
    if (this.held !== null) this.follow(there.find((pad) => pad.index === this.held))
    else for (const pad of there) this.consider(pad)
    if (this.held !== null) return 'held'
    return there.length > 0 ? 'ready' : 'none'
  }

  /** Driving ended for another reason: the button must be released before it counts again. */
  requireRelease(): void {
    this.held = null
    this.free.clear()
  }

  private rest(there: Pad[]): GamepadState {
    if (this.held !== null) this.wheel.release()
    this.requireRelease()
    return there.length > 0 ? 'ready' : 'none'
  }

  private follow(pad: Pad | undefined): void {
    if (pad === undefined) {
      this.requireRelease()
      this.wheel.gone()
    } else if (!isPressed(pad)) {
      this.held = null
      this.free.add(pad.index)
      this.wheel.release()
    } else {
      const { turn, ahead } = stickOf(pad)
      this.wheel.steer(turn, ahead)
    }
  }

  private consider(pad: Pad): void {
    if (!isPressed(pad)) {
      this.free.add(pad.index)
    } else if (this.held === null && this.free.delete(pad.index) && this.wheel.grab()) {
      this.held = pad.index
      this.follow(pad)
    }
  }
}
