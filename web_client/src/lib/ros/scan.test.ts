import { expect, it } from 'vitest'
import { nearest, points, radius, rings } from './scan'
import type { LaserScan } from './messages'

function scan(ranges: (number | null)[]): LaserScan {
  return { header: { stamp: { sec: 0, nanosec: 0 }, frame_id: 'laser' }, angle_min: 0, angle_increment: Math.PI / 2, range_min: 0.1, range_max: 10, ranges }
}

it('places points with x ahead and y left', () => {
  const found = Array.from(points(scan([1, 2, 3, 4])))
  const expected = [1, 0, 0, 2, -3, 0, 0, -4]
  found.forEach((value, i) => expect(value).toBeCloseTo(expected[i]!, 5))
})

it('leaves out what the sensor could not measure', () => {
  expect(points(scan([null, 0.05, 11, 2])).length).toBe(2)
  expect(points(scan([Number.NaN, Infinity])).length).toBe(0)
})

it('finds the nearest return', () => {
  expect(nearest(scan([null, 3, 0.05, 1.5]))).toBe(1.5)
  expect(nearest(scan([null]))).toBeNull()
})

it('chooses a radius that shows nearly all returns', () => {
  expect(radius(scan([1, 2, 4.5]), null)).toBe(5)
  expect(radius(scan([]), null)).toBe(5)
})

it('keeps the radius while it fits and changes it when it does not', () => {
  expect(radius(scan([4, 4, 4]), 8)).toBe(8)
  expect(radius(scan([9, 9, 9]), 8)).toBe(12)
  expect(radius(scan([1, 1, 1]), 8)).toBe(1)
  expect(radius(scan([null]), 8)).toBe(8)
})

it('draws a handful of rings at round distances', () => {
  expect(rings(5)).toEqual([2, 4])
  expect(rings(1)).toEqual([0.25, 0.5, 0.75, 1])
  for (const radiusM of [1, 2, 3, 5, 8, 12, 20, 30, 50, 80, 120, 200]) {
    expect(rings(radiusM).length).toBeGreaterThanOrEqual(1)
    expect(rings(radiusM).length).toBeLessThanOrEqual(5)
  }
})
