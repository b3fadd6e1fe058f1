import { beforeEach, describe, expect, it } from 'vitest'
import { Drive, FROZEN_MS, PUBLISH_INTERVAL_MS, type StopReason, stopWords, twist, ZERO } from './drive'
import type { Twist } from './types'

const LIMITS = { linear: 0.5, angular: 2 }

let now: number
let sent: Twist[]
let open: boolean
let obstacle: StopReason | null
let phases: [string, StopReason | null][]
let drive: Drive

beforeEach(() => {
  now = 1000
  sent = []
  open = true
  obstacle = null
  phases = []
  drive = new Drive(
    (command) => {
      if (open) sent.push(command)
      return open
    },
    () => obstacle,
    LIMITS,
    (phase, reason) => phases.push([phase, reason]),
  )
})

function pass(ms: number, step = 33): void {
  for (const end = now + ms; now < end; ) {
    now += Math.min(step, end - now)
    drive.tick(now)
  }
}

function ahead(): void {
  drive.grab('joystick', now)
  drive.steer('joystick', 0, 1, now)
}

describe('while held', () => {
  it('publishes between 10 and 20 times a second', () => {
    ahead()
    sent = []
    pass(2000)
    expect(sent.length).toBeGreaterThanOrEqual(20)
    expect(sent.length).toBeLessThanOrEqual(40)
  })

  it('publishes at once when the stick first moves', () => {
    ahead()
    expect(sent).toEqual([twist(0.5, 0)])
  })

  it('never publishes faster than the interval, however often the stick moves', () => {
    drive.grab('joystick', now)
    for (let i = 0; i < 200; i++) {
      now += 1
      drive.steer('joystick', 0, 1, now)
      drive.tick(now)
    }
    expect(sent.length).toBeLessThanOrEqual(Math.ceil(200 / PUBLISH_INTERVAL_MS) + 1)
  })

  it('scales by the limits, and by new limits at once', () => {
    drive.grab('joystick', now)
    drive.steer('joystick', -0.5, 1, now)
    drive.setLimits({ linear: 1, angular: 1 })
    pass(100)
    expect(sent[0]).toEqual(twist(0.5, -1))
    expect(sent.at(-1)).toEqual(twist(1, -0.5))
  })

  it('holds a stick beyond its edge, or without a value, within the limits', () => {
    drive.grab('joystick', now)
    drive.steer('joystick', -7, 7, now)
    expect(sent.at(-1)).toEqual(twist(0.5, -2))
    now += 100
    drive.steer('joystick', Number.NaN, Infinity, now)
    expect(sent.at(-1)).toEqual(twist(0, 0))
  })

  it('prefers the joystick to the keys', () => {
    drive.grab('keys', now)
    drive.steer('keys', 0, -1, now)
    ahead()
    pass(100)
    expect(sent.at(-1)).toEqual(twist(0.5, 0))
  })
})

describe('release', () => {
  it('sends exactly one zero, then nothing', () => {
    ahead()
    pass(300)
    sent = []
    drive.release('joystick')
    pass(2000)
    expect(sent).toEqual([ZERO])
    expect(drive.phase).toBe('idle')
  })

  it('of one input goes on while another is held', () => {
    ahead()
    drive.grab('keys', now)
    drive.steer('keys', 0, -1, now)
    drive.release('joystick')
    sent = []
    pass(100)
    expect(sent.at(-1)).toEqual(twist(-0.5, 0))
    drive.release('keys')
    expect(sent.at(-1)).toEqual(ZERO)
  })

  it('of an input that is not held sends nothing', () => {
    drive.release('keys')
    expect(sent).toEqual([])
  })
})

const OUTSIDE: StopReason[] = [
  'pointer_cancelled',
  'window_left',
  'page_hidden',
  'link_late',
  'link_closed',
  'not_allowed',
  'topic_changed',
]

describe.each(OUTSIDE)('a stop because of %s', (reason) => {
  it('sends exactly one zero and falls silent', () => {
    ahead()
    pass(200)
    sent = []
    drive.stop(reason)
    pass(1000)
    expect(sent).toEqual([ZERO])
    expect(phases.at(-1)).toEqual(['idle', reason])
  })

  it('ignores the hand that still holds, until it takes hold anew', () => {
    ahead()
    drive.stop(reason)
    sent = []
    now += 100
    drive.steer('joystick', 0, 1, now)
    pass(500)
    drive.release('joystick')
    expect(sent).toEqual([])
    ahead()
    expect(sent).toEqual([twist(0.5, 0)])
  })

  it('sends nothing when nobody drives', () => {
    drive.stop(reason)
    expect(sent).toEqual([])
    expect(phases).toEqual([])
  })
})

describe('obstacles', () => {
  it.each<StopReason>(['link_late', 'link_closed', 'not_allowed'])('%s refuses a new hold', (reason) => {
    obstacle = reason
    expect(drive.grab('joystick', now)).toBe(reason)
    drive.steer('joystick', 0, 1, now)
    pass(500)
    expect(sent).toEqual([])
  })

  it('that appear while driving end it with one zero', () => {
    ahead()
    pass(200)
    sent = []
    obstacle = 'link_late'
    pass(1000)
    expect(sent).toEqual([ZERO])
  })

  it('never let commands pile up: nothing goes out for what was missed', () => {
    ahead()
    open = false
    pass(500)
    open = true
    pass(1000)
    expect(sent).toEqual([twist(0.5, 0)])
    expect(phases.at(-1)).toEqual(['idle', 'link_closed'])
  })
})

describe('a frozen page', () => {
  it('does not go on with what was held before', () => {
    ahead()
    sent = []
    now += FROZEN_MS + 1
    drive.tick(now)
    pass(500)
    expect(sent).toEqual([ZERO])
    expect(phases.at(-1)).toEqual(['idle', 'page_frozen'])
  })

  it('does not count the time before taking hold', () => {
    drive.tick(now)
    now += 10_000
    ahead()
    pass(200)
    expect(drive.phase).toBe('driving')
  })
})

describe('the STOP button', () => {
  it('sends one zero at once while driving, and lets go', () => {
    ahead()
    sent = []
    expect(drive.stopNow()).toBe(true)
    pass(1000)
    expect(sent).toEqual([ZERO])
    expect(phases.at(-1)).toEqual(['idle', 'stop_button'])
  })

  it('sends a zero when nobody drives here', () => {
    expect(drive.stopNow()).toBe(true)
    expect(sent).toEqual([ZERO])
  })

  it('says when it could not be sent', () => {
    open = false
    expect(drive.stopNow()).toBe(false)
  })
})

it('tells the driver of stops that came from outside only', () => {
  expect(stopWords('released')).toBeNull()
  for (const reason of ['window_left', 'page_hidden', 'link_late', 'link_closed', 'page_frozen'] as const) {
    expect(stopWords(reason)).toMatch(/^Stopped: .+\.$/)
  }
})
