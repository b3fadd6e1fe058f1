import { beforeEach, describe, expect, it } from 'vitest'
import { Drive, FROZEN_MS, DEADMAN_EVENTS, type Limits, PUBLISH_INTERVAL_MS, SOURCES, type StopReason, stopWords, twist, ZERO } from './drive'
import type { Twist } from '../ros/messages'


let now: number
let limits: Limits
let sent: Twist[]
let open: boolean
let obstacle: StopReason | null
let phases: [string, StopReason | null][]
let drive: Drive

beforeEach(() => {
  now = 1000
  limits = { linear: 0.5, angular: 2 }
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
    () => limits,
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

  it('begins with a zero, and publishes at once when the stick first moves', () => {
    drive.grab('joystick', now)
    expect(sent).toEqual([ZERO])
    drive.steer('joystick', 0, 1, now)
    expect(sent).toEqual([ZERO, twist(0.5, 0)])
  })

  it('never publishes faster than the interval, however often the stick moves', () => {
    drive.grab('joystick', now)
    for (let i = 0; i < 200; i++) {
      now += 1
      drive.steer('joystick', 0, 1, now)
      drive.tick(now)
    }
    expect(sent.length).toBeLessThanOrEqual(Math.ceil(200 / PUBLISH_INTERVAL_MS) + 2)
  })

  it('scales by the limits, and by new limits at once', () => {
    drive.grab('joystick', now)
    drive.steer('joystick', -0.5, 1, now)
    limits = { linear: 1, angular: 1 }
    pass(100)
    expect(sent[1]).toEqual(twist(0.5, -1))
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

const ALL = Object.keys(DEADMAN_EVENTS) as StopReason[]
const OUTSIDE = ALL.filter((reason) => reason !== 'released')

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

  it('ignores the hand that still holds, until it takes hold again', () => {
    ahead()
    drive.stop(reason)
    sent = []
    now += 100
    drive.steer('joystick', 0, 1, now)
    pass(500)
    drive.release('joystick')
    expect(sent).toEqual([])
    ahead()
    expect(sent).toEqual([ZERO, twist(0.5, 0)])
  })

  it('sends nothing when nobody drives', () => {
    drive.stop(reason)
    expect(sent).toEqual([])
    expect(phases).toEqual([])
  })
})

describe.each(SOURCES)('an input that fails in the hand: %s', (source) => {
  it('ends driving with one zero when it was held', () => {
    drive.grab(source, now)
    drive.steer(source, 0, 1, now)
    sent = []
    drive.lose(source, 'capture_lost')
    pass(1000)
    expect(sent).toEqual([ZERO])
    expect(phases.at(-1)).toEqual(['idle', 'capture_lost'])
  })

  it('changes nothing when another one is held', () => {
    const other = SOURCES.find((each) => each !== source)!
    drive.grab(other, now)
    drive.lose(source, 'capture_lost')
    expect(drive.phase).toBe('driving')
    expect(drive.isHeld(other)).toBe(true)
  })
})

it('obeys the most exact of the inputs that are held', () => {
  const speeds = [1, 0.75, 0.5, 0.25]
  SOURCES.forEach((source, i) => {
    drive.grab(source, now)
    drive.steer(source, 0, speeds[i]!, now)
  })
  for (const [i, source] of SOURCES.entries()) {
    pass(100)
    expect(sent.at(-1)).toEqual(twist(0.5 * speeds[i]!, 0))
    drive.release(source)
  }
  expect(sent.at(-1)).toEqual(ZERO)
})

describe('obstacles', () => {
  it.each<StopReason>(['link_late', 'robot_late', 'link_closed', 'not_allowed', 'control_lost', 'robot_stopped'])('%s refuses a new hold', (reason) => {
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
    expect(sent).toEqual([ZERO, twist(0.5, 0)])
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

it('tells the driver of stops that came from outside, unless they are told elsewhere', () => {
  const silent = ['released', 'stop_button', 'not_allowed', 'control_lost']
  for (const reason of ALL) {
    if (silent.includes(reason)) expect(stopWords(reason)).toBeNull()
    else expect(stopWords(reason)).toMatch(/^Stopped: .+\.$/)
  }
})
