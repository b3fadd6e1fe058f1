import { beforeEach, describe, expect, it, vi } from 'vitest'
import { INK } from '../canvas'
import { type Mark, recorded } from '../canvasRecorder'
import { fromYaw, TransformTree } from '../ros/transforms'
import { drawMap, extent, levelFor, type Scene } from './drawMap'
import type { GridLevel, GridPicture } from './gridWorker'

const [WIDTH, HEIGHT] = [400, 200]
/** The world point 10, -5 is in the middle, pixel 200, 100. */
const CENTRE = { x: 10, y: -5 }

const level = (name: string, width: number, height: number, factor = 1) => ({ bitmap: { name, width, height }, factor }) as unknown as GridLevel

function picture(name: string, frame = 'map', heading = 0): GridPicture {
  return { place: { frame, resolution: 0.5, origin: { x: 8, y: -6, heading } }, levels: [level(name, 6, 4)], known: null }
}

function empty(scale = 20): Scene {
  return {
    view: { centre: CENTRE, scale },
    fixed: 'map',
    tree: new TransformTree(),
    map: null,
    costmap: null,
    scan: new Float32Array(),
    scanStale: false,
    plan: [],
    planStale: false,
    trail: [],
    robot: null,
    robotStale: false,
    goal: null,
    targets: [],
    draft: null,
  }
}

function drawn(scene: Scene): Mark[] {
  const { surface, marks } = recorded(WIDTH, HEIGHT)
  drawMap(surface, scene)
  return marks
}

/** The marks that these parts add to those of an empty map. */
function added(parts: Partial<Scene>, scale = 20): Mark[] {
  const usual = new Set(drawn(empty(scale)).map((mark) => JSON.stringify(mark)))
  return drawn({ ...empty(scale), ...parts }).filter((mark) => !usual.has(JSON.stringify(mark)))
}

beforeEach(() => {
  vi.stubGlobal('window', { devicePixelRatio: 1 })
  return () => vi.unstubAllGlobals()
})

describe('an empty map', () => {
  it('has a ground, lines at whole steps, and a scale bar, and nothing else', () => {
    const marks = drawn(empty())
    expect(marks.map(({ what, colour }) => [what, colour])).toEqual([
      ['rect', INK.ground],
      ['stroke', INK.line],
      ['stroke', INK.text],
      ['text', INK.text],
    ])
    const [ground, lines, bar, words] = marks as [Mark, Mark, Mark, Mark]
    expect(ground.points).toEqual([[0, 0], [400, 0], [400, 200], [0, 200]])
    // Every two metres: x from 0 to 20, y from -10 to 0.
    const across = [0, 40, 80, 120, 160, 200, 240, 280, 320, 360, 400].flatMap((x) => [[x, 0], [x, 200]])
    const along = [200, 160, 120, 80, 40, 0].flatMap((y) => [[0, y], [400, y]])
    expect(lines.points).toEqual([...across, ...along])
    expect(bar.points).toEqual([[12, 183], [12, 188], [52, 188], [52, 183]])
    expect(words.content).toBe('2 m')
  })

  it('has a scale bar in centimetres when it is enlarged', () => {
    expect(drawn(empty(400)).at(-1)!.content).toBe('10 cm')
  })
})

describe.each([
  ['map', 20],
  ['map', 40],
  ['costmap', 20],
] as const)('a %s at %d pixels a metre', (layer, scale) => {
  // Its lower left corner is 2 m left of the middle and 1 m below it; it is 3 m wide and 2 m high.
  const [left, bottom] = [200 - 2 * scale, 100 + scale]

  it('lies at its origin, lowest row first', () => {
    const [right, top] = [left + 3 * scale, bottom - 2 * scale]
    const grid = picture('it')
    const [mark, ...more] = added({ [layer]: grid }, scale)
    expect(more).toEqual([])
    expect(mark).toMatchObject({ what: 'image', content: grid.levels[0]!.bitmap, alpha: 1, smooth: false })
    expect(mark!.points).toEqual([[left, bottom], [right, bottom], [right, top], [left, top]])
  })

  it('is rotated with its origin', () => {
    const [mark] = added({ [layer]: picture('it', 'map', Math.PI / 2) }, scale)
    expect(mark!.points).toEqual([
      [left, bottom],
      [left, bottom - 3 * scale],
      [left - 2 * scale, bottom - 3 * scale],
      [left - 2 * scale, bottom],
    ])
  })
})

describe('a grid in another frame', () => {
  const tree = new TransformTree()
  // Its origin 8, -6 is at 14, -4 of the map, and its x axis points up.
  tree.set('map', 'odom', { translation: { x: 8, y: -12, z: 0 }, rotation: fromYaw(Math.PI / 2) }, 0)

  it('is moved and rotated into the frame of the map', () => {
    const [mark] = added({ tree, map: picture('it', 'odom') })
    expect(mark!.points).toEqual([[280, 80], [280, 20], [240, 20], [240, 80]])
    expect(extent(picture('it', 'odom'), 'map', tree)!.map(({ x, y }) => [Math.round(x * 100) / 100, Math.round(y * 100) / 100])).toEqual([
      [14, -4],
      [14, -1],
      [12, -1],
      [12, -4],
    ])
  })

  it('is not drawn, and has no extent, while the frames are not connected', () => {
    const lost = picture('it', 'elsewhere')
    expect(added({ tree, map: lost, costmap: lost })).toEqual([])
    expect(extent(lost, 'map', tree)).toBeNull()
  })
})

it('the extent of a grid is its known part', () => {
  const known = { minX: 2, minY: 0, maxX: 4, maxY: 2 }
  expect(extent({ ...picture('it'), known }, 'map', new TransformTree())).toEqual([
    { x: 9, y: -6 },
    { x: 10, y: -6 },
    { x: 10, y: -5 },
    { x: 9, y: -5 },
  ])
})

describe('of a large grid', () => {
  const levels = [level('fine', 64, 64), level('middle', 32, 32, 2), level('coarse', 16, 16, 4)]

  it.each([
    [8, 'fine'],
    [0.6, 'fine'],
    [0.5, 'middle'],
    [0.25, 'coarse'],
    [0.01, 'coarse'],
  ])('at %d pixels a cell the level is %s', (pixels, name) => {
    expect(levelFor(levels, pixels).bitmap).toMatchObject({ name })
  })

  it('each level covers the same place, and small pixels are smoothed', () => {
    const grid = { ...picture('it'), levels }
    const [fine] = added({ map: grid }, 1)
    vi.stubGlobal('window', { devicePixelRatio: 2 })
    const [finer] = added({ map: grid }, 1)
    expect(fine).toMatchObject({ content: { name: 'middle' }, smooth: false })
    expect(finer).toMatchObject({ content: { name: 'fine' }, smooth: true })
    expect(fine!.points).toEqual([[198, 101], [230, 101], [230, 69], [198, 69]])
    expect(finer!.points).toEqual(fine!.points)
  })
})

describe('scan points', () => {
  it.each([
    [20, [[240, 80], [180, 140]]],
    [40, [[280, 60], [160, 180]]],
  ])('at %d pixels a metre are where they were measured', (scale, centres) => {
    const marks = added({ scan: Float32Array.of(12, -4, 9, -7) }, scale)
    const corners = centres.map(([x, y]) => [[x! - 1.25, y! - 1.25], [x! + 1.25, y! - 1.25], [x! + 1.25, y! + 1.25], [x! - 1.25, y! + 1.25]])
    expect(marks.map(({ points }) => points)).toEqual(corners)
    expect(marks.map(({ what, colour }) => [what, colour])).toEqual(Array(2).fill(['rect', INK.accent]))
  })

  it('are grey when they are old', () => {
    expect(added({ scan: Float32Array.of(12, -4), scanStale: true })[0]!.colour).toBe(INK.stale)
  })
})

describe.each([
  ['path', INK.path, 1, (points: [number, number][]) => ({ plan: points.map(([x, y]) => ({ x, y })) })],
  ['trail', INK.accent, 0.55, (points: [number, number][]) => ({ trail: points })],
] as const)('the %s', (_name, colour, alpha, part) => {
  const POINTS: [number, number][] = [[10, -5], [12, -5], [12, -3]]

  it.each([
    [20, [[200, 100], [240, 100], [240, 60]]],
    [40, [[200, 100], [280, 100], [280, 20]]],
  ])('at %d pixels a metre goes through its points', (scale, points) => {
    expect(added(part(POINTS), scale)).toEqual([{ what: 'stroke', colour, alpha, points, radii: [] }])
  })

  it('of a single point is not drawn', () => {
    expect(added(part(POINTS.slice(0, 1)))).toEqual([])
  })
})

it('an old path is pale', () => {
  const plan = [{ x: 10, y: -5 }, { x: 12, y: -5 }]
  expect(added({ plan, planStale: true })).toMatchObject([{ colour: INK.path, alpha: 0.35 }])
})

describe('the robot', () => {
  it.each([
    ['right', 20, 0, [240, 80], [249, 80]],
    ['up', 20, Math.PI / 2, [240, 80], [240, 71]],
    ['down, enlarged', 40, -Math.PI / 2, [280, 60], [280, 69]],
  ])('that faces %s (%d pixels a metre)', (_words, scale, heading, at, tip) => {
    const marks = added({ robot: { x: 12, y: -4, heading } }, scale)
    expect(marks.map(({ what, colour }) => [what, colour])).toEqual([
      ['fill', 'rgb(14 19 24 / 75%)'],
      ['stroke', INK.accent],
      ['fill', INK.robot],
    ])
    const [, ring, arrow] = marks as [Mark, Mark, Mark]
    expect(ring).toMatchObject({ points: [at], radii: [13] })
    expect(arrow.points[0]).toEqual(tip)
  })

  it('is grey when its pose is old', () => {
    const marks = added({ robot: { x: 12, y: -4, heading: 0 }, robotStale: true })
    expect(marks.slice(1).map(({ colour }) => colour)).toEqual([INK.stale, INK.stale])
  })
})

describe.each([
  ['goal', INK.goal, 'goal'],
  ['goal that is being set', INK.path, 'draft'],
  ['target of a list', INK.path, 'targets'],
] as const)('the %s', (_words, colour, part) => {
  it.each([
    ['right', 20, 0, [240, 80], [278, 80]],
    ['up', 20, Math.PI / 2, [240, 80], [240, 42]],
    ['left, enlarged', 40, Math.PI, [280, 60], [242, 60]],
  ])('that faces %s (%d pixels a metre)', (_words, scale, heading, at, tip) => {
    const pose = { x: 12, y: -4, heading }
    const marks = added({ [part]: part === 'targets' ? [pose] : pose }, scale)
    expect(marks.map((mark) => [mark.what, mark.colour])).toEqual([
      ['stroke', colour],
      ['fill', colour],
    ])
    expect(marks[0]).toMatchObject({ radii: [7] })
    expect(marks[0]!.points[0]).toEqual(at)
    expect(marks[1]!.points[0]).toEqual(tip)
  })
})

it('all targets of a list are drawn', () => {
  const targets = [11, 12, 13].map((x) => ({ x, y: -5, heading: 0 }))
  const rings = added({ targets }).filter(({ what }) => what === 'stroke')
  expect(rings.map(({ points }) => points[0])).toEqual([[220, 100], [240, 100], [260, 100]])
})

it('the robot covers the scan, the scan the path, and all of them the grids', () => {
  const pose = (x: number) => ({ x, y: -5, heading: 0 })
  const marks = added({
    map: picture('map'),
    costmap: picture('costmap'),
    scan: Float32Array.of(12, -4),
    plan: [pose(10), pose(11)],
    trail: [[9, -5], [10, -5]],
    robot: pose(10),
    goal: pose(13),
    targets: [pose(11)],
    draft: pose(14),
  })
  const layers = marks.filter(({ what }) => what !== 'fill')
  expect(layers.map(({ content, colour, points }) => (content as { name: string } | undefined)?.name ?? [colour, points[0]])).toEqual([
    'map',
    'costmap',
    [INK.accent, [180, 100]],
    [INK.path, [200, 100]],
    [INK.accent, [238.75, 78.75]],
    [INK.path, [220, 100]],
    [INK.goal, [260, 100]],
    [INK.accent, [200, 100]],
    [INK.path, [280, 100]],
  ])
})
