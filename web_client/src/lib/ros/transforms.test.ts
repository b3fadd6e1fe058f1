import { describe, expect, it } from 'vitest'
import type { Transform } from './messages'
import { apply, baseFrame, compose, fixedFrame, flat, fromYaw, invert, TransformSearch, TransformTree } from './transforms'

const at = (x: number, y: number, heading = 0): Transform => ({ translation: { x, y, z: 0 }, rotation: fromYaw(heading) })
const QUARTER = Math.PI / 2

function near(found: Transform | null, x: number, y: number, heading: number): void {
  expect(found).not.toBeNull()
  const pose = flat(found!)
  expect([pose.x, pose.y, pose.heading].map((value) => Math.round(value * 1e6) / 1e6 + 0)).toEqual(
    [x, y, heading].map((value) => Math.round(value * 1e6) / 1e6 + 0),
  )
}

describe('transforms', () => {
  it('compose from the outside inwards', () => {
    near(compose(at(1, 0, QUARTER), at(2, 0, QUARTER)), 1, 2, Math.PI)
  })

  it('have an inverse', () => {
    const t = at(3, -2, 0.7)
    near(compose(t, invert(t)), 0, 0, 0)
    near(compose(invert(t), t), 0, 0, 0)
  })

  it('place what an upside-down scanner sees on the other side', () => {
    const hanging: Transform = { translation: { x: 0, y: 0, z: 1 }, rotation: { x: 1, y: 0, z: 0, w: 0 } }
    expect(apply(hanging, { x: 2, y: 1, z: 0 })).toMatchObject({ x: 2, y: -1, z: 1 })
  })
})

describe('the tree', () => {
  function robot(): TransformTree {
    const tree = new TransformTree()
    tree.set('map', 'odom', at(10, 0, QUARTER), 100)
    tree.set('/odom', 'base_link', at(2, 0), 200)
    tree.set('base_link', 'laser', at(0.5, 0, Math.PI), Infinity)
    return tree
  }

  it('leads from any frame to any other', () => {
    const tree = robot()
    near(tree.lookup('map', 'base_link'), 10, 2, QUARTER)
    near(tree.lookup('map', '/laser'), 10, 2.5, -QUARTER)
    near(tree.lookup('base_link', 'map'), -2, 10, -QUARTER)
    near(tree.lookup('laser', 'laser'), 0, 0, 0)
    tree.set('odom', 'local', at(1, 1), 200)
    near(tree.lookup('local', 'base_link'), 1, -1, 0)
  })

  it('knows which frames are not connected', () => {
    const tree = robot()
    expect(tree.lookup('map', 'camera')).toBeNull()
    expect(tree.oldestMs('map', 'camera')).toBeNull()
  })

  it('tells the oldest transform of a chain; static ones do not age', () => {
    const tree = robot()
    expect(tree.oldestMs('map', 'laser')).toBe(100)
    expect(tree.oldestMs('odom', 'laser')).toBe(200)
    expect(tree.oldestMs('base_link', 'laser')).toBe(Infinity)
  })

  it('interpolates between the last two transforms, and takes the newest for later times', () => {
    const tree = new TransformTree()
    tree.set('odom', 'base_link', at(0, 0, 3), 1, 10)
    // The second comes twice, as by two subscriptions; its angle is past π.
    for (const ms of [2, 3]) tree.set('odom', 'base_link', at(1, 0, -3), ms, 11)
    near(tree.lookup('odom', 'base_link', 10.5), 0.5, 0, Math.PI)
    near(tree.lookup('odom', 'base_link', 9.9), 0, 0, 3)
    near(tree.lookup('odom', 'base_link', 12), 1, 0, -3)
    near(tree.lookup('odom', 'base_link', 0), 1, 0, -3)
    tree.set('odom', 'base_link', at(5, 0, 0), 4, 2)
    near(tree.lookup('odom', 'base_link', 10.5), 5, 0, 0)
  })

  it('ends at a circle, and takes nothing that is no number', () => {
    const tree = robot()
    tree.set('laser', 'map', at(0, 0), 1)
    expect(tree.lookup('elsewhere', 'base_link')).toBeNull()
    tree.set('map', 'broken', at(NaN, 0), 1)
    expect(tree.has('broken')).toBe(false)
  })
})

describe('which frame is which', () => {
  const tree = new TransformTree()
  tree.set('odom', 'base_footprint', at(0, 0), 1)

  it.each([
    ['my_base', 'my_base'],
    ['', 'base_footprint'],
  ])('the body is what the odometry says, or has a usual name: %j', (said, base) => {
    expect(baseFrame(tree, said)).toBe(base)
  })

  it.each([
    ['/map', 'odom', 'map'],
    [null, 'odom', 'odom'],
    [null, null, 'odom'],
    [null, 'elsewhere', 'odom'],
  ])('with a map in %j and odometry in %j all is drawn in %j', (map, odom, fixed) => {
    expect(fixedFrame(tree, map, odom, 'base_footprint')).toBe(fixed)
  })

  it('prefers the frame of the map also where no map is published, and makes do with the robot itself', () => {
    const located = new TransformTree()
    located.set('map', 'odom', at(0, 0), 1)
    located.set('odom', 'base_link', at(0, 0), 1)
    expect(fixedFrame(located, null, 'odom', 'base_link')).toBe('map')
    expect(fixedFrame(new TransformTree(), null, null, 'base_link')).toBe('base_link')
  })
})

it('transforms are searched for while one is missing or old, at growing intervals', () => {
  const search = new TransformSearch()
  const on = (oldest: number | null, ...times: number[]) => times.map((now) => search.isOn(oldest, now))
  expect(on(null, 0, 900, 1000, 2900, 3000, 3900, 4000, 7900, 8000)).toEqual([true, true, false, false, true, true, false, false, true])
  expect(on(8000, 8500)).toEqual([false])
  expect(on(8000, 9500)).toEqual([true])
})
