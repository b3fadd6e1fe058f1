import { beforeEach, describe, expect, it } from 'vitest'
import { type Pad, PadDriver, stickOf } from './gamepad'

let did: string[]
let allowed: boolean
let driver: PadDriver

beforeEach(() => {
  did = []
  allowed = true
  driver = new PadDriver({
    grab: () => {
      did.push('grab')
      return allowed
    },
    steer: (turn, ahead) => did.push(`steer ${turn.toFixed(1)} ${ahead.toFixed(1)}`),
    release: () => did.push('release'),
    gone: () => did.push('gone'),
  })
})

function pad(pressed: boolean, x = 0, y = 0, index = 0): Pad {
  const buttons = Array.from({ length: 16 }, (_, i) => ({ pressed: pressed && i === 5 }))
  return { index, id: 'pad', connected: true, buttons, axes: [x, y, 0, 0] }
}

const look = (...pads: (Pad | null)[]) => driver.look(pads, true)

describe('the stick', () => {
  it('pushed away from oneself is ahead, to the left is left', () => {
    expect(stickOf(pad(true, 0, -1))).toEqual({ turn: 0, ahead: 1 })
    expect(stickOf(pad(true, -1, 0))).toEqual({ turn: 1, ahead: 0 })
  })

  it('has nothing in its middle, and grows from there without a jump', () => {
    expect(stickOf(pad(true, 0.1, -0.1))).toEqual({ turn: 0, ahead: 0 })
    expect(stickOf(pad(true, 0, -0.16)).ahead).toBeLessThan(0.02)
  })

  it('in a corner goes no further than all the way', () => {
    const { turn, ahead } = stickOf(pad(true, 1, 1))
    expect(Math.hypot(turn, ahead)).toBeCloseTo(1)
  })

  it('that says nonsense says nothing', () => {
    expect(stickOf(pad(true, Number.NaN, -1))).toEqual({ turn: 0, ahead: 0 })
    expect(stickOf({ ...pad(true), axes: [] })).toEqual({ turn: 0, ahead: 0 })
  })
})

describe('the dead man’s switch', () => {
  it('has to be held for anything to move', () => {
    look(pad(false, 0, -1))
    expect(did).toEqual([])
    look(pad(true, 0, -1))
    look(pad(true, 0, -0.9))
    expect(did).toEqual(['grab', 'steer 0.0 1.0', 'steer 0.0 0.9'])
  })

  it('lets go once when it is lifted', () => {
    look(pad(false))
    look(pad(true, 0, -1))
    did = []
    expect(look(pad(false, 0, -1))).toBe('ready')
    look(pad(false, 0, -1))
    expect(did).toEqual(['release'])
  })

  it('that was held before anybody looked has to be lifted first', () => {
    look(pad(true, 0, -1))
    expect(did).toEqual([])
    look(pad(false))
    look(pad(true, 0, -1))
    expect(did[0]).toBe('grab')
  })

  it('has to be lifted after a stop from outside', () => {
    look(pad(false))
    look(pad(true, 0, -1))
    driver.letGo()
    did = []
    look(pad(true, 0, -1))
    expect(did).toEqual([])
    look(pad(false))
    look(pad(true, 0, -1))
    expect(did[0]).toBe('grab')
  })

  it('that was refused has to be lifted first', () => {
    allowed = false
    look(pad(false))
    look(pad(true, 0, -1))
    look(pad(true, 0, -1))
    expect(did).toEqual(['grab'])
  })
})

it('says so when the pad that is held goes', () => {
  look(pad(false))
  look(pad(true, 0, -1))
  did = []
  expect(look(null)).toBe('none')
  look(null)
  expect(did).toEqual(['gone'])
})

it('takes a pad that is not connected any more for gone', () => {
  look(pad(false))
  look(pad(true, 0, -1))
  look({ ...pad(true, 0, -1), connected: false })
  expect(did.at(-1)).toBe('gone')
})

it('lets go when control or the focus is lost, and does not take hold again by itself', () => {
  look(pad(false))
  look(pad(true, 0, -1))
  did = []
  expect(driver.look([pad(true, 0, -1)], false)).toBe('ready')
  look(pad(true, 0, -1))
  expect(did).toEqual(['release'])
})

it('obeys the pad whose switch was pressed first', () => {
  look(pad(false, 0, 0, 0), pad(false, 0, 0, 1))
  look(pad(false, 0, 0, 0), pad(true, -1, 0, 1))
  did = []
  look(pad(true, 1, 0, 0), pad(true, -1, 0, 1))
  expect(did).toEqual(['steer 1.0 0.0'])
})
