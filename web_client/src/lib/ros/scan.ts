/** A laser scan as points around the robot, and the scale to draw it at. Metres; x ahead, y left (REP 103). */
import type { LaserScan } from './messages'

const SCALES = [1, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8, 9, 10, 12, 15, 20, 25, 30, 40, 50, 80, 120, 200]

/** Pairs x, y of all valid returns, one after the other. */
export function points(scan: LaserScan): Float32Array {
  const found = new Float32Array(scan.ranges.length * 2)
  let n = 0
  scan.ranges.forEach((range, i) => {
    if (range === null || !(range >= scan.range_min && range <= scan.range_max)) return
    const angle = scan.angle_min + i * scan.angle_increment
    found[n++] = range * Math.cos(angle)
    found[n++] = range * Math.sin(angle)
  })
  return found.subarray(0, n)
}

/** The nearest return in metres, or null when there is none. */
export function nearest(scan: LaserScan): number | null {
  let best = Infinity
  for (const range of scan.ranges) {
    if (range !== null && range >= scan.range_min && range <= scan.range_max && range < best) best = range
  }
  return best === Infinity ? null : best
}

/** A radius in metres that shows nearly all returns. The present one is kept while it fits, for a steady view. */
export function radius(scan: LaserScan, present: number | null): number {
  const valid = scan.ranges.filter((r): r is number => r !== null && r >= scan.range_min && r <= scan.range_max)
  if (valid.length === 0) return present ?? 5
  valid.sort((a, b) => a - b)
  const far = valid[Math.ceil((valid.length - 1) * 0.95)]!
  if (present !== null && far <= present && far > present * 0.45) return present
  // Larger than needed; otherwise the view would change at every metre.
  const wanted = present !== null && far > present ? far * 1.15 : far
  return SCALES.find((scale) => scale >= wanted) ?? SCALES.at(-1)!
}

/** Distances in metres at which to draw rings. */
export function rings(radiusM: number): number[] {
  const step = [0.25, 0.5, 1, 2, 3, 5, 10, 20, 30, 50].find((s) => radiusM / s <= 4.5) ?? 100
  const found: number[] = []
  for (let r = step; r <= radiusM * 1.001; r += step) found.push(r)
  return found
}
