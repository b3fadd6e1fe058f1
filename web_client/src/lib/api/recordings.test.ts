import { describe, expect, it } from 'vitest'
import { contents, fitting, obstacle, pictureTopic, progress, sizes } from './recordings'
import type { Recordable, Recording } from './types'

const POSSIBLE: Recordable = { topics: ['/odom'], cameras: [], denied: '', megabytes: 10_000, left: 4000, full: '' }

function recording(given: Partial<Recording>): Recording {
  return {
    id: 'a',
    robot: 'rover',
    user: 'ann',
    topics: ['/odom'],
    cameras: [],
    begun: 0,
    ended: null,
    lasted: 0,
    state: 'recording',
    reason: '',
    seconds: 100,
    megabytes: 10,
    bytes: 0,
    messages: 0,
    drops: 0,
    problems: [],
    ...given,
  }
}

it('counts by the limit that is nearer', () => {
  expect(progress(recording({ lasted: 50, bytes: 1e6 }))).toBe(0.5)
  expect(progress(recording({ lasted: 10, bytes: 9e6 }))).toBe(0.9)
  expect(progress(recording({ lasted: null }))).toBe(0)
  expect(progress(recording({ lasted: 101 }))).toBe(1)
})

describe('why nothing can be recorded', () => {
  it('is told, the right before the room before the robot', () => {
    const denied = { ...POSSIBLE, topics: [], denied: 'record on /odom needs the level operator', left: 0 }
    expect(obstacle(denied, true)).toEqual({
      words: 'You may not record this robot. Record on /odom needs the level operator.',
    })
    const full = obstacle({ ...POSSIBLE, left: 0.5 }, true)
    expect(full?.words).toContain('use all 10 GB')
    expect(full?.command).toContain('--recordings-gb')
    expect(obstacle({ ...POSSIBLE, megabytes: 0, left: 0 }, true)?.words).toContain('stores no recordings')
    expect(obstacle({ ...POSSIBLE, left: 0, full: 'the disk is nearly full' }, true)).toEqual({
      words: 'The disk is nearly full.',
    })
    expect(obstacle(POSSIBLE, true)?.words).toContain('offline')
    expect(obstacle({ ...POSSIBLE, topics: [] }, false)?.words).toContain('nothing to record')
  })

  it('is nothing when there is something and room for it', () => {
    expect(obstacle(POSSIBLE, false)).toBeNull()
  })
})

describe('sizes', () => {
  it('go up to what is left', () => {
    expect(sizes(4000.7)).toEqual([
      [100, '100 MB'],
      [1000, '1 GB'],
      [4000, '4 GB, all that is left'],
    ])
    expect(sizes(40)).toEqual([[40, '40 MB, all that is left']])
    expect(sizes(1e6).at(-1)).toEqual([100_000, '100 GB, the most'])
  })

  it('are taken as large as wanted, or as there is room', () => {
    expect(fitting(sizes(4000), 1000)).toBe(1000)
    expect(fitting(sizes(700), 1000)).toBe(700)
    expect(fitting(sizes(4000), 50)).toBe(100)
  })
})

it('knows where a camera is recorded', () => {
  expect(pictureTopic('/camera')).toBe('/camera/compressed')
  expect(pictureTopic('/camera/compressed')).toBe('/camera/compressed')
})

it('says how much it is', () => {
  expect(contents(1, 2)).toBe('1 topic and 2 cameras')
  expect(contents(3, 0)).toBe('3 topics')
  expect(contents(0, 1)).toBe('1 camera')
})
