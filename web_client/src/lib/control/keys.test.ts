import { beforeEach, describe, expect, it } from 'vitest'
import { direction, Focus, HeldKeys, isDriveKey, isField, SILENT_MS } from './keys'

it('adds up the keys held', () => {
  expect(direction(new Set(['KeyW', 'ArrowLeft']))).toEqual({ turn: 1, ahead: 1 })
  expect(direction(new Set(['KeyW', 'KeyS', 'KeyD']))).toEqual({ turn: -1, ahead: 0 })
  expect(direction(new Set(['KeyW', 'ArrowUp']))).toEqual({ turn: 0, ahead: 1 })
  expect(isDriveKey('KeyQ')).toBe(false)
})

it.each<[boolean, string, string?]>([
  [true, 'SELECT'],
  [true, 'OPTION'],
  [true, 'TEXTAREA'],
  [true, 'INPUT', 'text'],
  [true, 'INPUT', 'date'],
  [true, 'INPUT', 'color'],
  [true, 'INPUT', 'file'],
  [false, 'INPUT', 'range'],
  [false, 'INPUT', 'checkbox'],
  [false, 'BUTTON'],
  [false, 'BODY'],
])('says %s of whether it is a field: %s %s', (is, tagName, type) => {
  expect(isField({ tagName, type })).toBe(is)
})

it('knows text that is edited in any element', () => {
  expect(isField({ tagName: 'DIV', isContentEditable: true })).toBe(true)
  expect(isField(null)).toBe(false)
})

describe('the keys', () => {
  const text = { tagName: 'INPUT', type: 'text' }
  const slider = { tagName: 'INPUT', type: 'range' }
  const box = { tagName: 'INPUT', type: 'checkbox' }
  const select = { tagName: 'SELECT', matches: () => false }
  const button = { tagName: 'BUTTON' }
  const link = { tagName: 'A' }
  let focus: Focus

  beforeEach(() => {
    focus = new Focus()
  })

  it('are those of the control that the keyboard led to, as far as it is worked with them', () => {
    const needs = (control: { tagName: string } | null) =>
      ['KeyW', 'ArrowUp', 'Space'].filter((code) => focus.needs(control, code))
    expect(needs(text)).toEqual(['KeyW', 'ArrowUp', 'Space'])
    expect(needs(select)).toEqual(['KeyW', 'ArrowUp', 'Space'])
    expect(needs(slider)).toEqual(['ArrowUp'])
    expect(needs(box)).toEqual(['Space'])
    expect(needs(button)).toEqual(['Space'])
    expect(needs(link)).toEqual([])
    expect(needs(null)).toEqual([])
  })

  it.each([select, slider, box, button])('are not those of %o that the pointer was used on', (control) => {
    focus.touch(control)
    focus.enter(control)
    expect(['KeyW', 'ArrowUp', 'Space'].filter((code) => focus.needs(control, code))).toEqual([])
  })

  it.each<[string, () => boolean]>([
    ['is open', () => true],
    [
      'may be open',
      () => {
        throw new SyntaxError('not a valid selector')
      },
    ],
  ])('are those of a list that %s, whatever opened it', (_, matches) => {
    const list = { tagName: 'SELECT', matches }
    focus.touch(list)
    focus.enter(list)
    expect(focus.needs(list, 'KeyW')).toBe(true)
  })

  it('are always those of a field that is typed into', () => {
    focus.touch(text)
    focus.enter(text)
    expect(focus.needs(text, 'KeyW')).toBe(true)
  })

  it('are those of a control to which the keyboard came back', () => {
    focus.touch(button)
    focus.enter(button)
    focus.enter(slider)
    focus.enter(button)
    expect(focus.needs(button, 'Space')).toBe(true)
  })
})

describe('a key that is held', () => {
  let held: HeldKeys

  beforeEach(() => {
    held = new HeldKeys()
    held.press('KeyW')
  })

  function repeats(code: string, fromMs: number, count: number, everyMs = 33): number {
    for (let i = 0; i < count; i++) held.repeat(code, fromMs + i * everyMs)
    return fromMs + (count - 1) * everyMs
  }

  it('is held until it comes up where no key is repeated', () => {
    expect(held.isSilent(1e9)).toBe(false)
    expect(held.release('KeyW')).toBe(true)
    expect(held.release('KeyW')).toBe(false)
    expect(held.codes.size).toBe(0)
  })

  it('that was repeated and is no more came up unheard', () => {
    const last = repeats('KeyW', 500, 5)
    expect(held.isSilent(last + SILENT_MS)).toBe(false)
    expect(held.isSilent(last + SILENT_MS + 1)).toBe(true)
  })

  it('is not judged by a single repeat, nor by slow ones', () => {
    held.repeat('KeyW', 500)
    expect(held.isSilent(1e9)).toBe(false)
    repeats('KeyW', 1000, 4, 400)
    expect(held.isSilent(1e9)).toBe(false)
  })

  it.each<[string, () => void]>([
    ['is pressed beside it', () => held.press('KeyA')],
    ['beside it comes up', () => held.release('KeyA')],
    ['that does not drive is repeated', () => held.repeat('ShiftLeft', 700)],
    ['that does not drive is pressed', () => held.forget()],
  ])('is repeated no more when another one %s', (_, happens) => {
    held.press('KeyA')
    repeats('KeyW', 500, 5)
    happens()
    expect(held.isSilent(1e9)).toBe(false)
  })

  it('that is let go is waited for no more', () => {
    repeats('KeyW', 500, 5)
    held.clear()
    expect(held.isSilent(1e9)).toBe(false)
  })
})
