import { describe, expect, it } from 'vitest'
import { type Cause, ended, type GoalEnd, goalMessage, progress } from './navigation'

it('the goal is a stamped pose, of the newest time, in its frame', () => {
  expect(goalMessage({ x: 1, y: 2, heading: Math.PI, frame: 'map' })).toEqual({
    pose: {
      header: { stamp: { sec: 0, nanosec: 0 }, frame_id: 'map' },
      pose: { position: { x: 1, y: 2, z: 0 }, orientation: { x: 0, y: 0, z: 1, w: expect.closeTo(0) } },
    },
    behavior_tree: '',
  })
})

describe('progress', () => {
  const time = (sec: number) => ({ sec, nanosec: 0 })

  it('tells distance, times and recoveries', () => {
    const all = { distance_remaining: 3.21, navigation_time: time(12), estimated_time_remaining: time(8), number_of_recoveries: 2 }
    expect(progress(all)).toEqual(['3.2 m left', '0:12 so far', '0:08 to go', '2 recoveries'])
  })

  it('leaves out what the navigator does not know', () => {
    expect(progress({})).toEqual([])
    expect(progress({ distance_remaining: NaN, estimated_time_remaining: time(0), number_of_recoveries: 0 })).toEqual([])
  })
})

describe('the end of a goal in words', () => {
  it.each<[GoalEnd, Cause, string]>([
    [{ status: 5, values: {} }, 'control_lost', 'The goal was cancelled, because this page no longer has control.'],
    [{ status: 4, values: {} }, null, 'The robot has arrived.'],
    [{ status: 5, values: {} }, 'page_cancelled', 'The goal is cancelled.'],
    [{ status: 5, values: 'control was lost' }, null, 'The goal was cancelled: control was lost.'],
    [{ status: 5, values: {} }, 'robot_stopped', 'The goal was cancelled, because the robot was stopped.'],
    [{ status: 6, values: { error_code: 208, error_msg: '' } }, null, 'The robot did not arrive: there is no path to the goal.'],
    [{ status: 6, values: { error_code: 208, error_msg: 'blocked' } }, null, 'The robot did not arrive: blocked.'],
    [{ status: 6, values: { error_code: 12345 } }, null, 'The robot did not arrive: error code 12345.'],
    [{ status: 6, values: {} }, null, 'The robot did not arrive.'],
    [{ status: 0, values: 'only ann may do that' }, null, 'The goal was refused: only ann may do that.'],
  ])('%j, %s', (end, cause, words) => {
    expect(ended(end, cause)).toBe(words)
  })
})
