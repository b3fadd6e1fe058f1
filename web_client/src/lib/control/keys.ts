/** Driving by keys. Keys are identified by position, so WASD works on any layout. */

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

/** Inputs that neither take text nor open a picker. */
const PLAIN = new Set(['range', 'checkbox', 'radio', 'button', 'submit', 'reset', 'image'])

/** Those of them that the space bar operates. */
const PRESSED = Array.from(PLAIN).filter((type) => type !== 'range')

function isInput(control: Control, ...types: string[]): boolean {
  return control.tagName === 'INPUT' && types.includes(control.type ?? '')
}

function isList(control: Control): boolean {
  return ['SELECT', 'OPTION', 'OPTGROUP'].includes(control.tagName)
}

/** Whether an element takes text, or opens a list or picker that swallows keyup events. */
export function isField(control: Control | null): boolean {
  if (control === null) return false
  if (control.isContentEditable === true || control.tagName === 'TEXTAREA' || isList(control)) return true
  return control.tagName === 'INPUT' && !PLAIN.has(control.type ?? '')
}

/** Whether the browser reports that a list is closed; older browsers do not. */
function isClosed(list: Control): boolean {
  try {
    return list.matches?.(':open') === false
  } catch {
    return false
  }
}

/** Whether a key belongs to the focused element: always for text fields, for others only after keyboard navigation. */
export class Focus {
  private touched: Control | null = null

  /** The pointer was pressed on an element, or on none. */
  touch(control: Control | null): void {
    this.touched = control
  }

  /** An element got the focus. */
  enter(control: Control | null): void {
    if (control !== this.touched) this.touched = null
  }

  /** Whether the focused element needs a key for itself. */
  needs(control: Control | null, code: string): boolean {
    if (control === null) return false
    if (isList(control)) return control !== this.touched || !isClosed(control)
    if (isField(control)) return true
    if (control === this.touched) return false
    if (code === 'Space') return ['BUTTON', 'SUMMARY'].includes(control.tagName) || isInput(control, ...PRESSED)
    return code.startsWith('Arrow') && isInput(control, 'range', 'radio')
  }
}

/** Longest interval of key repeats that are relied on, milliseconds. */
const REPEAT_MS = 200
/** Time without a key repeat after which the key counts as released, milliseconds. */
export const SILENT_MS = 500

/** The keys that are held, as far as a page can know.
 *
 * A page gets keydown and keyup events, but a list or dialog over it may swallow the keyup. The system repeats only the key
 * that was pressed last, and only if key repeat is switched on. So the end of a repetition counts as a release, but a
 * missing repetition proves nothing.
 */
export class HeldKeys {
  private readonly down = new Set<string>()
  /** Time of the last repeat of the last key; null while it cannot be relied on. */
  private heardMs: number | null = null
  private repeated: { code: string; atMs: number } | null = null

  get codes(): ReadonlySet<string> {
    return this.down
  }

  press(code: string): void {
    this.forget()
    this.down.add(code)
  }

  /** Another key was pressed or released. */
  forget(): void {
    this.repeated = null
    this.heardMs = null
  }

  /** The system repeats a key.
   *
   * @param atMs time of `performance.now()`
   */
  repeat(code: string, atMs: number): void {
    const before = this.repeated
    this.forget()
    if (!this.down.has(code)) return
    this.repeated = { code, atMs }
    if (before?.code === code && atMs - before.atMs <= REPEAT_MS) this.heardMs = atMs
  }

  /** A key was released. Returns whether it was held. */
  release(code: string): boolean {
    this.forget()
    return this.down.delete(code)
  }

  clear(): void {
    this.forget()
    this.down.clear()
  }

  /** Whether the repetition of a held key has ended. */
  isSilent(nowMs: number): boolean {
    return this.heardMs !== null && nowMs - this.heardMs > SILENT_MS
  }
}
