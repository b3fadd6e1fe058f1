/** Which keys drive, and what the keys held add up to. Keys are named by place, so WASD works on any layout. */

const AHEAD = new Set(['KeyW', 'ArrowUp'])
const BACK = new Set(['KeyS', 'ArrowDown'])
const LEFT = new Set(['KeyA', 'ArrowLeft'])
const RIGHT = new Set(['KeyD', 'ArrowRight'])

export function isDriveKey(code: string): boolean {
  return [AHEAD, BACK, LEFT, RIGHT].some((keys) => keys.has(code))
}

/** The direction of the keys held: turn (left is positive) and ahead, each -1, 0 or 1. */
export function direction(held: ReadonlySet<string>): { turn: number; ahead: number } {
  const any = (keys: Set<string>) => (Array.from(keys).some((key) => held.has(key)) ? 1 : 0)
  return { turn: any(LEFT) - any(RIGHT), ahead: any(AHEAD) - any(BACK) }
}

export interface Control {
  tagName: string
  type?: string
  isContentEditable?: boolean
  matches?(selector: string): boolean
}

/** Inputs that neither take letters nor open anything. */
const PLAIN = new Set(['range', 'checkbox', 'radio', 'button', 'submit', 'reset', 'image'])

/** Those of them that are worked with the space bar. */
const PRESSED = Array.from(PLAIN).filter((type) => type !== 'range')

function isInput(control: Control, ...types: string[]): boolean {
  return control.tagName === 'INPUT' && types.includes(control.type ?? '')
}

function isList(control: Control): boolean {
  return ['SELECT', 'OPTION', 'OPTGROUP'].includes(control.tagName)
}

/** Whether a control is typed into, or opens a list or a picker, to which a browser gives the keys that come up. */
export function isField(control: Control | null): boolean {
  if (control === null) return false
  if (control.isContentEditable === true || control.tagName === 'TEXTAREA' || isList(control)) return true
  return control.tagName === 'INPUT' && !PLAIN.has(control.type ?? '')
}

/** Whether a browser says that a list is closed; an older one does not know. */
function isClosed(list: Control): boolean {
  try {
    return list.matches?.(':open') === false
  } catch {
    return false
  }
}

/** Whose a key is: what is typed belongs to the field; any other control has keys only when the keyboard led to it. */
export class Focus {
  private touched: Control | null = null

  /** The pointer was put on a control, or on none. */
  touch(control: Control | null): void {
    this.touched = control
  }

  /** A control got the focus. */
  enter(control: Control | null): void {
    if (control !== this.touched) this.touched = null
  }

  /** Whether the control that has the focus needs a key for itself. */
  needs(control: Control | null, code: string): boolean {
    if (control === null) return false
    if (isList(control)) return control !== this.touched || !isClosed(control)
    if (isField(control)) return true
    if (control === this.touched) return false
    if (code === 'Space') return ['BUTTON', 'SUMMARY'].includes(control.tagName) || isInput(control, ...PRESSED)
    return code.startsWith('Arrow') && isInput(control, 'range', 'radio')
  }
}

/** Repeats of a held key that come no slower than this are counted on, milliseconds. */
const REPEAT_MS = 200
/** So long without the next one, and the key came up unheard. */
export const SILENT_MS = 500

/** The keys that are held, as far as a page can know.
 *
 * Nothing tells a page which keys are down: it hears them go down and come up, and what opens over it may swallow the
 * second. A key that the system repeats is a sign of life, but only of the key that was pressed last, until another goes
 * down or comes up, and only where repeating is on. So its end is obeyed, and its absence proves nothing.
 */
export class HeldKeys {
  private readonly down = new Set<string>()
  /** When the last key was repeated last; null while that can't be counted on. */
  private heardMs: number | null = null
  private repeated: { code: string; atMs: number } | null = null

  get codes(): ReadonlySet<string> {
    return this.down
  }

  press(code: string): void {
    this.forget()
    this.down.add(code)
  }

  /** A key was pressed or came up that is none of those held. */
  forget(): void {
    this.repeated = null
    this.heardMs = null
  }

  /** The system repeats a key.
   *
   * @param atMs when, on the clock of `performance.now()`
   */
  repeat(code: string, atMs: number): void {
    const before = this.repeated
    this.forget()
    if (!this.down.has(code)) return
    this.repeated = { code, atMs }
    if (before?.code === code && atMs - before.atMs <= REPEAT_MS) this.heardMs = atMs
  }

  /** A key came up. Returns whether it was held. */
  release(code: string): boolean {
    this.forget()
    return this.down.delete(code)
  }

  clear(): void {
    this.forget()
    this.down.clear()
  }

  /** Whether a key that was repeated all the time is repeated no more. */
  isSilent(nowMs: number): boolean {
    return this.heardMs !== null && nowMs - this.heardMs > SILENT_MS
  }
}
