import { beforeEach, describe, expect, it } from 'vitest'
import { type Pad, GamepadDriver, stickOf } from './gamepad'

let did: string[]
let allowed: boolean
let driver: GamepadDriver

beforeEach(() => {
  did = []
  allowed = true
  driver = new GamepadDriver({
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

const poll = (...pads: (Pad | null)[]) => driver.poll(pads, true)

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
    poll(pad(false, 0, -1))
    expect(did).toEqual([])
    poll(pad(true, 0, -1))
    poll(pad(true, 0, -0.9))
    expect(did).toEqual(['grab', 'steer 0.0 1.0', 'steer 0.0 0.9'])
  })

  it('lets go once when it is lifted', () => {
    poll(pad(false))
    poll(pad(true, 0, -1))
    did = []
    expect(poll(pad(false, 0, -1))).toBe('ready')
    poll(pad(false, 0, -1))
    expect(did).toEqual(['release'])
  })

  it('that was held before anybody looked has to be lifted first', () => {
    poll(pad(true, 0, -1))
    expect(did).toEqual([])
    poll(pad(false))
    poll(pad(true, 0, -1))
    expect(did[0]).toBe('grab')
  })

  it('has to be lifted after a stop from outside', () => {
    poll(pad(false))
    poll(pad(true, 0, -1))
    driver.requireRelease()
    did = []
    poll(pad(true, 0, -1))
    expect(did).toEqual([])
    poll(pad(false))
    poll(pad(true, 0, -1))
    expect(did[0]).toBe('grab')
  })

  it('that was refused has to be lifted first', () => {
    allowed = false
    poll(pad(false))
    poll(pad(true, 0, -1))
    poll(pad(true, 0, -1))
    expect(did).toEqual(['grab'])
  })
})

it('says so when the pad that is held goes', () => {
  poll(pad(false))
  poll(pad(true, 0, -1))
  did = []
  expect(poll(null)).toBe('none')
  poll(null)
  expect(did).toEqual(['gone'])
})

it('takes a pad that is not connected any more for gone', () => {
  poll(pad(false))
  poll(pad(true, 0, -1))
  poll({ ...pad(true, 0, -1), connected: false })
  expect(did.at(-1)).toBe('gone')
})

it('lets go when control or the focus is lost, and does not take hold again by itself', () => {
  poll(pad(false))
  poll(pad(true, 0, -1))
  did = []
  expect(driver.poll([pad(true, 0, -1)], false)).toBe('ready')
  poll(pad(true, 0, -1))
  expect(did).toEqual(['release'])
})

it('obeys the pad whose switch was pressed first', () => {
  poll(pad(false, 0, 0, 0), pad(false, 0, 0, 1))
  poll(pad(false, 0, 0, 0), pad(true, -1, 0, 1))
  did = []
  poll(pad(true, 1, 0, 0), pad(true, -1, 0, 1))
  expect(did).toEqual(['steer 1.0 0.0'])
})
