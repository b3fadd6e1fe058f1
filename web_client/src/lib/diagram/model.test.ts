import { describe, expect, it } from 'vitest'
import { endText } from '../api/pipes'
import type { NewPipe, PipeStatus } from '../api/types'
import type { TypeDef } from './fields'
import { columnsOf, layout } from './layout'
import {
  type Element,
  elementsOfProgram,
  elementsOfRobot,
  elementsOfRole,
  elementsOfCalled,
  elementsOfTopic,
  actionId,
  argumentId,
  fieldId,
  fullName,
  linesOfMappings,
  linesOfPipes,
  linkOf,
  matching,
  pipeFor,
  replyId,
  serviceId,
  settingsOf,
  topicId,
} from './model'
import type { Item } from './roleDocument'

const TWIST: TypeDef[] = [{ type: 'Twist', fieldnames: ['x', 'names'], fieldtypes: ['float64', 'string'], fieldarraylen: [-1, 2] }]
const FLOAT: TypeDef[] = [{ type: 'Float', fieldnames: ['data', 'unit'], fieldtypes: ['float64', 'string'], fieldarraylen: [-1, -1] }]

function robot(name: string, topic: string, type: string, way: 'gives' | 'takes'): Element[] {
  const [publishers, subscribers] = way === 'gives' ? [['/n'], ['/relay']] : [['/relay'], ['/n']]
  const topics = [
    { name: topic, types: [type], publishers, subscribers, moves: topic === '/cmd_vel' },
    { name: '/rosout', types: ['Log'], publishers: ['/n'], subscribers: [], moves: false },
  ]
  const [found, service] = elementsOfRobot({ name, online: true, topics, services: [{ name: '/beep', types: ['Trigger'], moves: false }], actions: [] })
  return [found!, ...elementsOfTopic(found!, type === 'Float' ? FLOAT : TWIST, undefined), service!]
}

const PAD = robot('pad', '/heat', 'Float', 'gives')
const ROVER = robot('rover', '/cmd_vel', 'Twist', 'takes')
const item = (name: string, type: string, more: Partial<Item> = {}): Item => ({
  iri: `fierro:${name}`,
  name,
  type,
  lane: null,
  resources: [],
  mappings: [],
  ...more,
})
const ROLE = elementsOfRole(
  'R',
  {
    parts: { subject: '', action: '', directObject: '' },
    items: [
      item('HEAT', 'field', { resources: ['robots/pad/topics/heat#/data'], mappings: ['fierro:Port'] }),
      item('UNIT', 'field', { resources: ['robots/pad/topics/heat#/unit'] }),
      item('Port', 'port'),
      item('SPEED', 'field', { resources: ['robots/rover/topics/cmd_vel#/x'] }),
      item('BEEP', 'function'),
      item('Maker', 'process'),
    ],
  },
  (name) => (name === 'pad' ? 'Float' : 'Twist'),
  (name) => (name === 'pad' ? FLOAT : TWIST),
)
const LAMP = elementsOfProgram({ name: 'lamp', ports: ['power'], functions: ['blink'] })
const REQUEST: TypeDef[] = [{ type: 'Switch_Request', fieldnames: ['on'], fieldtypes: ['bool'], fieldarraylen: [-1] }]
const REPLY: TypeDef[] = [{ type: 'Switch_Response', fieldnames: ['success', 'message'], fieldtypes: ['bool', 'string'], fieldarraylen: [-1, -1] }]
const [SERVICE] = elementsOfRobot({ name: 'home', online: true, topics: [], services: [{ name: '/switch', types: ['Switch'], moves: false }], actions: [] })
const HOME = [SERVICE!, ...elementsOfCalled(SERVICE!, REQUEST, REPLY)]
const [ACTION] = elementsOfRobot({
  name: 'home',
  online: true,
  topics: [],
  services: [],
  actions: [{ name: '/dock', types: ['Dock'], moves: true }, { name: '/relay/run_function', types: ['Run'], moves: false }],
})
const GOAL: TypeDef[] = [{ type: 'Dock_Goal', fieldnames: ['speed'], fieldtypes: ['float64'], fieldarraylen: [-1] }]
const RESULT: TypeDef[] = [{ type: 'Dock_Result', fieldnames: ['seconds'], fieldtypes: ['float64'], fieldarraylen: [-1] }]
const DOCK = [ACTION!, ...elementsOfCalled(ACTION!, GOAL, RESULT)]
const named = (name: string) => [...PAD, ...ROVER, ...ROLE, ...LAMP, ...HOME].find((each) => each.name === name)!

describe('elements', () => {
  it('of robots are topics, fields and services, without those of tools', () => {
    expect(PAD.map(({ name, kind, gives, takes }) => [name, kind, gives, takes])).toEqual([
      ['/heat', 'topic', true, false],
      ['data', 'field', true, false],
      ['unit', 'field', true, false],
      ['/beep', 'service', true, true],
    ])
    expect(named('names[0]')).toMatchObject({ takes: false, basic: 'string' })
  })

  it('of services are arguments and fields of replies, those of programs ports and functions', () => {
    expect(HOME.map((each) => [fullName(each), each.kind, each.gives, each.takes])).toEqual([
      ['/switch', 'service', true, true],
      ['/switch() on', 'argument', false, true],
      ['/switch() success', 'reply', true, false],
      ['/switch() message', 'reply', true, false],
    ])
    expect(LAMP.map(({ node, name, kind }) => [node, name, kind])).toEqual([
      ['program:lamp', 'power', 'port'],
      ['program:lamp', 'blink', 'function'],
    ])
  })

  it('of actions are arguments of goals and fields of results, without the relay’s own', () => {
    expect(DOCK.map((each) => [fullName(each), each.kind, each.gives, each.takes])).toEqual([
      ['/dock', 'action', true, true],
      ['/dock{} speed', 'argument', false, true],
      ['/dock{} seconds', 'reply', true, false],
    ])
    const [dock, speed, seconds] = DOCK
    const data = named('data')
    expect(linkOf(data, speed!)).toMatchObject({ makes: 'pipe', moves: true, to: { at: { robot: 'home', action: '/dock' }, path: 'speed' } })
    expect(linkOf(seconds!, named('power'))).toMatchObject({ makes: 'pipe', from: { at: { action: '/dock' }, path: 'seconds' } })
    expect(linkOf(data, dock!)).toBe('data is a field and /dock an action. Open /dock and choose a field of it.')
    const sent = { ...STATUS, target: { ...NOTHING, robot: 'home', action: '/dock' }, fields: [{ ...STATUS.fields[0]!, target: 'speed' }] }
    const shown = [topicId('pad', '/heat'), actionId('home', '/dock')]
    const ends = (more: string[]) => linesOfPipes([sent], new Set([...shown, ...more])).map(({ from, to }) => [from, to])
    expect(ends([])).toEqual([shown])
    expect(ends([speed!.id])).toEqual([[shown[0], speed!.id]])
  })

  it('of Roles have the type of the field that they stand for', () => {
    expect(named('HEAT')).toMatchObject({ basic: 'float64', place: { robot: 'pad', topic: '/heat', path: 'data' } })
    expect(named('Maker')).toMatchObject({ gives: false, takes: false, place: null })
  })

  it('are found by words', () => {
    expect(matching([...PAD, ...ROVER], 'rover X').map(({ name }) => name)).toEqual(['x'])
    expect(matching(PAD, ' ')).toHaveLength(4)
  })
})

describe('a line', () => {
  it.each([
    ['/heat', '/cmd_vel', '/heat has messages of Float, /cmd_vel takes Twist. Open both and connect a field to a field.'],
    ['data', '/cmd_vel', 'data is a field and /cmd_vel a whole message. Open /cmd_vel and choose a field of it.'],
    ['/heat', 'x', '/heat is a whole message and x a field. Open /heat and choose a field of it.'],
    ['unit', 'x', 'unit is text and x is a number.'],
    ['/cmd_vel', '/heat', '/cmd_vel gives no values.'],
    ['/heat', '/heat', 'An element can’t be connected to itself.'],
    ['HEAT', 'BEEP', 'BEEP is called and HEAT is data; only like elements can be mapped.'],
    ['UNIT', 'SPEED', 'unit is text and x is a number.'],
    ['HEAT', 'Port', 'They are mapped already.'],
    ['HEAT', 'Maker', 'Maker takes no values.'],
    ['/heat', 'SPEED', 'SPEED stands for robots/rover/topics/cmd_vel#/x already.'],
    ['/heat', 'BEEP', 'BEEP is called; it can’t stand for a topic.'],
    ['data', '/switch', 'data is a field and /switch a service. Open /switch and choose a field of it.'],
    ['/switch', '/cmd_vel', '/switch replies and /cmd_vel is a topic.'],
    ['/switch', 'x', '/switch is a service and x a field. Open /switch'],
    ['success', 'on', '/switch() can’t be connected to itself.'],
    ['message', 'x', 'message is text and x is a number.'],
    ['power', 'blink', 'a pipe needs a robot at one end.'],
    ['power', 'BEEP', 'BEEP is called; it can’t stand for a port.'],
    ['blink', 'Port', 'blink is called; Port stands for data.'],
  ])('from %s to %s is refused in words', (from, to, words) => {
    expect(linkOf(named(from), named(to))).toContain(words)
  })

  it.each([
    ['/heat', '/switch', ['pad:/heat', ''], ['home:/switch()', '']],
    ['data', 'on', ['pad:/heat', 'data'], ['home:/switch()', 'on']],
    ['success', 'x', ['home:/switch()', 'success'], ['rover:/cmd_vel', 'x']],
    ['/switch', '/beep', ['home:/switch()', ''], ['pad:/beep()', '']],
    ['/heat', 'power', ['pad:/heat', ''], ['programs/lamp/ports/power', '']],
    ['data', 'power', ['pad:/heat', 'data'], ['programs/lamp/ports/power', 'data']],
    ['power', 'x', ['programs/lamp/ports/power', 'data'], ['rover:/cmd_vel', 'x']],
    ['power', '/switch', ['programs/lamp/ports/power', ''], ['home:/switch()', '']],
    ['data', 'blink', ['pad:/heat', 'data'], ['programs/lamp/functions/blink', 'data']],
  ])('from %s to %s makes a pipe', (from, to, source, target) => {
    const link = linkOf(named(from), named(to))
    if (typeof link === 'string' || link.makes !== 'pipe') throw new Error(String(link))
    const ends = [link.from, link.to].map(({ at, path }) => [endText(at), path])
    expect(ends).toEqual([source, target])
    const { after } = pipeFor(link, []) as { after: NewPipe }
    expect(after).toMatchObject({ source: link.from.at, target: link.to.at, fields: link.to.path === '' ? [] : [{ source: source[1] }] })
  })

  it('binds elements of Roles to ports, functions, services and fields of them', () => {
    const resource = (from: string, to: string) => linkOf(named(from), named(to))
    expect(resource('power', 'Port')).toMatchObject({ resource: 'programs/lamp/ports/power' })
    expect(resource('blink', 'BEEP')).toMatchObject({ resource: 'programs/lamp/functions/blink' })
    expect(resource('/switch', 'BEEP')).toMatchObject({ resource: 'robots/home/services/switch' })
    expect(resource('Port', 'on')).toMatchObject({ resource: 'robots/home/services/switch#/on' })
  })

  it('makes a pipe, a mapping or a binding', () => {
    expect(linkOf(named('data'), named('x'))).toMatchObject({ makes: 'pipe', moves: true, from: { path: 'data' }, to: { path: 'x' } })
    expect(linkOf(named('HEAT'), named('SPEED'))).toEqual({ makes: 'mapping', role: 'R', from: 'fierro:HEAT', to: 'fierro:SPEED' })
    const binding = { makes: 'binding', role: 'R', iri: 'fierro:Port', resource: 'robots/pad/topics/heat#/data' }
    expect(linkOf(named('data'), named('Port'))).toEqual(binding)
    expect(linkOf(named('Port'), named('x'))).toMatchObject({ resource: 'robots/rover/topics/cmd_vel#/x' })
  })
})

const NOTHING = { robot: '', topic: '', type: '', service: '', action: '', program: '', port: '', function: '' }

const STATUS: PipeStatus = {
  name: 'pad-heat-rover-cmd_vel',
  owner: 'ann',
  source: { ...NOTHING, robot: 'pad', topic: '/heat' },
  target: { ...NOTHING, robot: 'rover', topic: '/cmd_vel' },
  fields: [{ source: 'data', target: 'x', scale: 2, offset: 0, table: {} }],
  rate: 5,
  state: 'running',
  why: '',
  moves: true,
  messages: 0,
  drops: 0,
  encoded: 0,
  latency_ms: null,
}

describe('the pipe for a line', () => {
  const link = (to: string) => linkOf(named('data'), { ...named('x'), end: { ...named('x').end!, path: to } })
  const made = (to: string, pipes: PipeStatus[]) => {
    const found = link(to)
    if (typeof found === 'string' || found.makes !== 'pipe') throw new Error(String(found))
    return pipeFor(found, pipes)
  }

  it('is new, has a free name, and waits for a start where it moves a robot', () => {
    expect(made('x', [])).toMatchObject({ before: null, after: { name: 'pad-heat-rover-cmd_vel', start: false, fields: [{ source: 'data', target: 'x' }] } })
    expect(made('x', [{ ...STATUS, fields: [] }])).toMatchObject({ after: { name: 'pad-heat-rover-cmd_vel-2' } })
  })

  it('takes a further field of the same topics into the pipe that there is', () => {
    const change = made('y', [STATUS])
    expect(change).toMatchObject({ before: { fields: [{ scale: 2 }] }, after: { rate: 5, fields: [{ target: 'x', scale: 2 }, { target: 'y' }] } })
    expect(made('x', [STATUS])).toBe('x gets its value from another field already.')
  })

  it('starts again after undo only where no robot moves', () => {
    expect([settingsOf(STATUS).start, settingsOf({ ...STATUS, moves: false }).start]).toEqual([false, true])
  })
})

describe('lines', () => {
  it('of pipes end at fields where these are shown, else at topics', () => {
    const topics = [topicId('pad', '/heat'), topicId('rover', '/cmd_vel')]
    const ends = (shown: string[]) => linesOfPipes([STATUS], new Set(shown)).map(({ from, to }) => [from, to])
    expect(ends(topics)).toEqual([topics])
    const inner = fieldId('pad', '/heat', 'data')
    expect(ends([...topics, inner])).toEqual([[inner, topics[1]]])
    expect(ends([topics[0]!])).toEqual([])
  })

  it('of pipes end at arguments, replies, ports and functions', () => {
    const call = { ...STATUS, target: { ...NOTHING, robot: 'home', service: '/switch' }, fields: [{ ...STATUS.fields[0]!, target: 'on' }] }
    const shown = [topicId('pad', '/heat'), serviceId('home', '/switch'), 'program:lamp power']
    const ends = (pipe: PipeStatus, more: string[] = []) => linesOfPipes([pipe], new Set([...shown, ...more])).map(({ from, to }) => [from, to])
    expect(ends(call)).toEqual([[shown[0], shown[1]]])
    expect(ends(call, [argumentId(serviceId('home', '/switch'), 'on')])).toEqual([[shown[0], argumentId(serviceId('home', '/switch'), 'on')]])
    const answer = { ...STATUS, source: call.target, target: { ...NOTHING, program: 'lamp', port: 'power' } }
    expect(ends(answer, [replyId(serviceId('home', '/switch'), 'data')])).toEqual([[replyId(serviceId('home', '/switch'), 'data'), 'program:lamp power']])
  })

  it('of mappings go within a Role, or to another that is shown', () => {
    const other = elementsOfRole('S', { parts: { subject: '', action: '', directObject: '' }, items: [item('Y', 'field', { mappings: ['fierro:SPEED', 'fierro:Gone'] })] }, () => '', () => [])
    expect(linesOfMappings([...ROLE, ...other]).map(({ from, to }) => [from, to])).toEqual([
      ['role:R fierro:HEAT', 'role:R fierro:Port'],
      ['role:S fierro:Y', 'role:R fierro:SPEED'],
    ])
  })
})

describe('the layout', () => {
  const box = (id: string, more = {}) => ({ id, role: false, rows: 3, out: 0, in: 0, ...more })

  it('has sources left, targets beside them, Roles right, nothing over another', () => {
    const boxes = [box('a', { in: 1 }), box('b', { out: 1 }), box('r', { role: true }), box('c')]
    const found = layout(boxes, columnsOf(boxes))
    expect(found['b']!.x).toBeLessThan(found['a']!.x)
    expect(found['a']!.x).toBeLessThan(found['r']!.x)
    const places = Object.values(found).map(({ x, y }) => `${x} ${y}`)
    expect(new Set(places).size).toBe(4)
  })

  it('sets two robots side by side, and leaves those that were moved', () => {
    const boxes = [box('a'), box('b')]
    const columns = columnsOf(boxes)
    expect(layout(boxes, columns)['b']!.x).toBeGreaterThan(0)
    expect(layout(boxes, columns, { b: { x: 7, y: 8 } })).toEqual({ a: { x: 0, y: 0 }, b: { x: 7, y: 8 } })
  })

  it('is one column on a phone', () => {
    const found = layout([box('a'), box('r', { role: true })], {}, {}, true)
    expect([found['a']!.x, found['r']!.x, found['a']!.y < found['r']!.y]).toEqual([0, 0, true])
  })

  it('keeps columns when a line is added', () => {
    const columns = columnsOf([box('a'), box('b')])
    expect(columnsOf([box('a', { in: 1 }), box('b', { out: 1 })], columns)).toEqual(columns)
  })
})
