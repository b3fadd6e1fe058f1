import { expect, it } from 'vitest'
import { Hold, HOLD_MS } from './holdToConfirm'

it('is done once after it was held for long enough', () => {
  const hold = new Hold()
  hold.press(100)
  expect(hold.share(100 + HOLD_MS / 2)).toBeCloseTo(0.5)
  expect(hold.isDone(100 + HOLD_MS - 1)).toBe(false)
  expect(hold.isDone(100 + HOLD_MS)).toBe(true)
  expect(hold.isDone(100 + 2 * HOLD_MS)).toBe(false)
})

it('begins again when it is lifted, and not when it is pressed again meanwhile', () => {
  const hold = new Hold()
  hold.press(0)
  hold.press(1000)
  expect(hold.isDone(HOLD_MS)).toBe(true)
  hold.press(2000)
  hold.lift()
  expect(hold.share(2000 + HOLD_MS)).toBe(0)
  expect(hold.isDone(2000 + HOLD_MS)).toBe(false)
})
