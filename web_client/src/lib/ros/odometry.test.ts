import { expect, it } from 'vitest'
import { pose, Trail, view } from './odometry'
import type { Odometry } from './messages'

function message(x: number, y: number, heading: number): Odometry {
  const orientation = { x: 0, y: 0, z: Math.sin(heading / 2), w: Math.cos(heading / 2) }
  const zero = { x: 0, y: 0, z: 0 }
  return {
    header: { stamp: { sec: 0, nanosec: 0 }, frame_id: 'odom' },
    child_frame_id: 'base_link',
    pose: { pose: { position: { x, y, z: 0 }, orientation } },
    twist: { twist: { linear: { ...zero, x: 0.4 }, angular: { ...zero, z: -0.2 } } },
  }
}

it.each([0, 1, -1, 3, -3])('reads the heading %f out of the quaternion', (heading) => {
  expect(pose(message(1, 2, heading)).heading).toBeCloseTo(heading)
})

it('reads position and speeds', () => {
  expect(pose(message(1, 2, 0))).toMatchObject({ x: 1, y: 2, speed: 0.4, turn: -0.2 })
})

it('thins the trail and bounds it', () => {
  const trail = new Trail()
  for (let i = 0; i < 5000; i++) trail.add(i * 0.01, 0)
  expect(trail.points.length).toBeLessThanOrEqual(600)
  expect(trail.points.at(-1)![0]).toBeGreaterThan(49.9)
})

it('begins a new trail when the odometry jumps', () => {
  const trail = new Trail()
  trail.add(0, 0)
  trail.add(1, 0)
  trail.add(30, 0)
  expect(trail.points).toEqual([[30, 0]])
})

it('ignores positions that are no numbers', () => {
  const trail = new Trail()
  trail.add(Number.NaN, 0)
  expect(trail.points).toEqual([])
})

it('shows the whole trail, and at least two metres', () => {
  expect(view([])).toEqual({ centreX: 0, centreY: 0, half: 1 })
  expect(view([[5, 5]]).half).toBe(1)
  const seen = view([
    [0, 0],
    [10, 4],
  ])
  expect(seen).toMatchObject({ centreX: 5, centreY: 2 })
  expect(seen.half).toBeGreaterThan(5)
})
