import { describe, expect, it } from 'vitest'
import { fitted, goalPose, gridStep, panned, pinched, type Point, SCALES, toScreen, toWorld, type Viewport, zoomed } from './viewport'

const size = { width: 400, height: 200 }
const view: Viewport = { centre: { x: 10, y: -5 }, scale: 20 }
const near = (found: Point, x: number, y: number) => {
  expect(found.x).toBeCloseTo(x)
  expect(found.y).toBeCloseTo(y)
}

describe('between screen and world', () => {
  it.each([
    [{ x: 200, y: 100 }, 10, -5],
    [{ x: 220, y: 100 }, 11, -5],
    [{ x: 200, y: 80 }, 10, -4],
  ])('%j is at %d, %d', (screen, x, y) => {
    near(toWorld(view, size, screen), x, y)
    near(toScreen(view, size, { x, y }), screen.x, screen.y)
  })
})

describe('gestures', () => {
  it('a drag moves the world with the finger', () => {
    const before = toWorld(view, size, { x: 50, y: 60 })
    near(toScreen(panned(view, 30, -10), size, before), 80, 50)
  })

  it('a zoom keeps the point under the pointer, within limits', () => {
    const at = { x: 10, y: 190 }
    const before = toWorld(view, size, at)
    const larger = zoomed(view, size, at, 3)
    expect(larger.scale).toBe(60)
    near(toScreen(larger, size, before), at.x, at.y)
    expect(zoomed(view, size, at, 1e9).scale).toBe(SCALES.most)
    expect(zoomed(view, size, at, 1e-9).scale).toBe(SCALES.least)
  })

  it('a pinch keeps both points under the fingers', () => {
    const before: [Point, Point] = [{ x: 100, y: 100 }, { x: 200, y: 100 }]
    const after: [Point, Point] = [{ x: 90, y: 120 }, { x: 290, y: 120 }]
    const world = before.map((point) => toWorld(view, size, point))
    const found = pinched(view, size, before, after)
    world.forEach((point, i) => near(toScreen(found, size, point), after[i]!.x, after[i]!.y))
  })
})

it('shows a whole rectangle', () => {
  const found = fitted({ minX: 0, minY: 0, maxX: 4, maxY: 40 }, size)
  near(found.centre, 2, 20)
  const corner = toScreen(found, size, { x: 4, y: 40 })
  expect(corner.y).toBeGreaterThan(0)
  expect(corner.x).toBeLessThan(size.width)
})

describe('a goal', () => {
  const pressed = { x: 220, y: 80 }

  it.each([
    ['right', { x: 260, y: 80 }, 0],
    ['up', { x: 220, y: 40 }, Math.PI / 2],
    ['left', { x: 180, y: 80 }, Math.PI],
    ['down', { x: 220, y: 120 }, -Math.PI / 2],
  ])('dragged to the %s faces there', (_words, now, heading) => {
    const found = goalPose(view, size, pressed, now, null)
    near(found, 11, -4)
    expect(found.heading).toBeCloseTo(heading)
  })

  it('that is only pressed faces away from the robot', () => {
    const found = goalPose(view, size, pressed, { x: 223, y: 80 }, { x: 11, y: -6, heading: 0 })
    expect(found.heading).toBeCloseTo(Math.PI / 2)
    expect(goalPose(view, size, pressed, pressed, null).heading).toBe(0)
  })
})

it.each([
  [1000, 0.1],
  [20, 2],
  [0.5, 100],
])('at %d pixels a metre there is a line every %d m', (scale, step) => {
  expect(gridStep(scale)).toBe(step)
})
