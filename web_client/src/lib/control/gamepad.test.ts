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
  return { index, id: 'pad', connected: true, mapping: 'standard', buttons, axes: [x, y, 0, 0] }
}

/** A pad whose layout the browser does not know. */
function other(buttons: number[] = [], x = 0, y = 0, index = 0): Pad {
  const all = Array.from({ length: 12 }, (_, i) => ({ pressed: buttons.includes(i) }))
  return { index, id: 'other', connected: true, mapping: '', buttons: all, axes: [x, y] }
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

describe('a pad without the standard layout', () => {
  it('drives by none of its buttons', () => {
    expect(poll(other())).toBe('unknown')
    for (let button = 0; button < 12; button++) {
      poll(other([], 0, -1))
      expect(poll(other([button], 0, -1))).toBe('unknown')
    }
    expect(did).toEqual([])
  })

  it('in the first slot changes nothing for a standard pad in the second', () => {
    const stuck = other([4, 5, 6, 7], -1, -1)
    expect(poll(stuck, pad(false, 0, 0, 1))).toBe('ready')
    expect(poll(stuck, pad(true, 0, -1, 1))).toBe('held')
    expect(did).toEqual(['grab', 'steer 0.0 1.0'])
  })

  it('drives by the button that was chosen, and by no other', () => {
    poll(other())
    driver.choose()
    expect(poll(other())).toBe('choosing')
    expect(poll(other([9]))).toBe('ready')
    expect(driver.chosen).toEqual({ other: 9 })
    // The press that chose the button does not drive.
    poll(other([9], 0, -1))
    expect(did).toEqual([])
    poll(other([5], 0, -1))
    expect(did).toEqual([])
    expect(poll(other([9], 0, -1))).toBe('held')
    expect(did).toEqual(['grab', 'steer 0.0 1.0'])
  })

  it('remembers the button of each kind of pad', () => {
    driver = new GamepadDriver({ grab: () => true, steer: () => undefined, release: () => undefined, gone: () => undefined }, { other: 2 })
    expect(poll(other())).toBe('ready')
    expect(poll(other([2]))).toBe('held')
    expect(driver.poll([{ ...other(), id: 'third' }], false)).toBe('unknown')
    expect(driver.poll([{ ...other(), id: 'toString' }], false)).toBe('unknown')
  })

  it('takes only a button that was released, and only with a centred stick', () => {
    driver.choose()
    expect(poll(other([3]))).toBe('choosing')
    poll(other([], -1, 0))
    expect(poll(other([3], -1, 0))).toBe('off-centre')
    poll(other())
    expect(poll(other([3]))).toBe('ready')
    expect(driver.chosen).toEqual({ other: 3 })
  })

  it('releases the robot while a button is chosen', () => {
    poll(pad(false))
    poll(pad(true, 0, -1))
    did = []
    driver.choose()
    poll(pad(true, 0, -1))
    expect(did).toEqual(['release'])
    driver.cancelChoice()
    poll(pad(true, 0, -1))
    expect(did).toEqual(['release'])
  })
})
