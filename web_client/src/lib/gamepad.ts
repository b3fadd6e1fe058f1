/** A gamepad as an input: only while a button on its shoulder is held, the dead man's switch. */

/** The deflection below which a stick counts as in its middle: worn ones never quite return. */
export const DEAD_ZONE = 0.15

/** Shoulder buttons and triggers of the standard layout (Gamepad, W3C, section 10). */
const SWITCHES = [4, 5, 6, 7]
const HORIZONTAL = 0
const VERTICAL = 1

/** What is used of the browser's `Gamepad`. */
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

/** What the pad steers. */
export interface Wheel {
  /** Takes hold; false when something stands in the way. */
  grab(): boolean
  steer(turn: number, ahead: number): void
  release(): void
  gone(): void
}

/** The left stick, with nothing in its middle and the rest spread over the whole way. */
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

export type PadState = 'none' | 'ready' | 'held'

/** Looks at the pads and tells the wheel what changed. */
export class PadDriver {
  /** The pad whose switch was pressed. */
  private held: number | null = null
  /** Switches that were seen free: one that is pressed already when the page begins to look holds nothing. */
  private free = new Set<number>()

  constructor(private readonly wheel: Wheel) {}

  /** One look.
   *
   * @param pads what `navigator.getGamepads()` says
   * @param mayHold whether a switch may count now: control is held, and the page has the focus
   */
  look(pads: readonly (Pad | null)[], mayHold: boolean): PadState {
    const there = pads.filter((pad): pad is Pad => pad !== null && pad.connected)
    if (!mayHold) return this.rest(there)
    if (this.held !== null) this.follow(there.find((pad) => pad.index === this.held))
    else for (const pad of there) this.consider(pad)
    if (this.held !== null) return 'held'
    return there.length > 0 ? 'ready' : 'none'
  }

  /** Driving ended for another reason: the switch has to be let go before it counts again. */
  letGo(): void {
    this.held = null
    this.free.clear()
  }

  private rest(there: Pad[]): PadState {
    if (this.held !== null) this.wheel.release()
    this.letGo()
    return there.length > 0 ? 'ready' : 'none'
  }

  private follow(pad: Pad | undefined): void {
    if (pad === undefined) {
      this.letGo()
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
