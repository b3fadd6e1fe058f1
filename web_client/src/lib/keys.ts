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

interface Control {
  tagName: string
  isContentEditable?: boolean
}

/** Whether a focused element needs the letter and arrow keys for itself. */
export function takesKeys(element: Control | null): boolean {
  if (element === null) return false
  return element.isContentEditable === true || ['INPUT', 'TEXTAREA', 'SELECT'].includes(element.tagName)
}

/** Whether a focused element is worked with the space bar. */
export function takesSpace(element: Control | null): boolean {
  if (element === null) return false
  return takesKeys(element) || ['BUTTON', 'A', 'SUMMARY'].includes(element.tagName)
}
