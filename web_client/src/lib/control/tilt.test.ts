import { beforeEach, describe, expect, it } from 'vitest'
import { askLeave, poseOf, SILENT_MS, steering, TiltDriver, whyNoTilt } from './tilt'

const pose = (beta: number, gamma: number, screen = 0) => poseOf({ beta, gamma }, screen)!

describe('how the phone is held', () => {
  it('lying flat it is level', () => {
    expect(pose(0, 0).pitch).toBeCloseTo(0)
    expect(pose(0, 0).roll).toBeCloseTo(0)
  })

  it('goes on without a jump through upright, where the angles of the browser do not', () => {
    expect(pose(89, 0).pitch).toBeCloseTo(89)
    expect(pose(91, 0).pitch).toBeCloseTo(91)
  })

  it('follows the picture when it is turned', () => {
    // On its left side, the picture turned by 90 degrees: what was the phone's top is the left edge now.
    expect(pose(0, -40, 90).pitch).toBeCloseTo(40)
    expect(pose(20, 0, 90).roll).toBeCloseTo(20)
    expect(pose(0, 40, 270).pitch).toBeCloseTo(40)
    expect(pose(20, 0, 180).pitch).toBeCloseTo(-20)
  })

  it('is not known where the phone says nothing', () => {
    expect(poseOf({ beta: null, gamma: 3 }, 0)).toBeNull()
    expect(poseOf({ beta: Number.NaN, gamma: 3 }, 0)).toBeNull()
  })
})

describe('steering', () => {
  const neutral = { pitch: 40, roll: 0 }

  it('tilted away from oneself is ahead, to the left is left', () => {
    expect(steering({ pitch: 10, roll: 0 }, neutral)).toEqual({ turn: 0, ahead: 1 })
    expect(steering({ pitch: 70, roll: 0 }, neutral)).toEqual({ turn: 0, ahead: -1 })
    expect(steering({ pitch: 40, roll: -30 }, neutral)).toEqual({ turn: 1, ahead: 0 })
  })

  it('a hand that trembles is standing still', () => {
    expect(steering({ pitch: 43, roll: -3 }, neutral)).toEqual({ turn: 0, ahead: 0 })
  })

  it('takes the short way round', () => {
    expect(steering({ pitch: -175, roll: 0 }, { pitch: 175, roll: 0 }).ahead).toBeGreaterThan(-0.5)
  })
})

describe('the button', () => {
  let did: string[]
  let allowed: boolean
  let tilt: TiltDriver

  beforeEach(() => {
    did = []
    allowed = true
    tilt = new TiltDriver({
      grab: () => {
        did.push('grab')
        return allowed
      },
      steer: (turn, ahead) => did.push(`steer ${turn} ${ahead}`),
      release: () => did.push('release'),
      silent: () => did.push('silent'),
    })
  })

  const tilted = (beta: number, nowMs: number) => tilt.handleOrientation({ beta, gamma: 0 }, 0, nowMs)

  it('has to be held for anything to move', () => {
    tilted(40, 0)
    expect(did).toEqual([])
    expect(tilt.press(10)).toBe(true)
    tilted(10, 20)
    expect(did).toEqual(['grab', 'steer 0 1'])
    tilt.lift()
    tilted(10, 30)
    tilt.lift()
    expect(did).toEqual(['grab', 'steer 0 1', 'release'])
  })

  it('takes how the phone is held at that moment for standing still', () => {
    tilted(60, 0)
    tilt.press(10)
    tilted(61, 20)
    expect(did.at(-1)).toBe('steer 0 0')
  })

  it('drives nothing when something stands in the way', () => {
    allowed = false
    tilted(40, 0)
    expect(tilt.press(10)).toBe(false)
    tilted(10, 20)
    expect(did).toEqual(['grab'])
  })

  it('stops when the phone falls silent, once', () => {
    tilted(40, 0)
    tilt.press(10)
    tilt.tick(SILENT_MS)
    expect(did).toEqual(['grab'])
    tilt.tick(SILENT_MS + 1)
    tilt.tick(SILENT_MS + 100)
    expect(did).toEqual(['grab', 'silent'])
    tilted(10, SILENT_MS + 200)
    expect(did).toEqual(['grab', 'silent'])
  })

  it('that is pressed while the phone is silent drives nothing', () => {
    expect(tilt.press(0)).toBe(false)
    tilted(40, 0)
    expect(tilt.press(SILENT_MS + 1)).toBe(false)
    expect(did).toEqual(['silent', 'silent'])
  })

  it('takes an answer without angles for none', () => {
    tilted(40, 0)
    tilt.press(10)
    tilt.handleOrientation({ beta: null, gamma: null }, 0, SILENT_MS)
    tilt.tick(SILENT_MS + 1)
    expect(did.at(-1)).toBe('silent')
  })

  it('has to be pressed again after a stop from outside', () => {
    tilted(40, 0)
    tilt.press(10)
    tilt.requireRelease()
    tilted(10, 20)
    tilt.tick(10_000)
    tilt.lift()
    expect(did).toEqual(['grab'])
  })
})

it('says why it is missing', () => {
  expect(whyNoTilt({ isSecureContext: false })).toContain('https')
  expect(whyNoTilt({ isSecureContext: true })).toContain('does not report')
  expect(whyNoTilt({ isSecureContext: true, DeviceOrientationEvent: class {} })).toBeNull()
})

it('asks leave where that is needed, and takes silence for no', async () => {
  expect(await askLeave(class {})).toBe(true)
  expect(await askLeave({ requestPermission: async () => 'granted' })).toBe(true)
  expect(await askLeave({ requestPermission: async () => 'denied' })).toBe(false)
  expect(await askLeave({ requestPermission: () => Promise.reject(new Error('not from a tap')) })).toBe(false)
})
