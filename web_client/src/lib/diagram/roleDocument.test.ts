import { describe, expect, it } from 'vitest'
import { addressOf, bindingOf, boundTo, type Document, mappingOf, nameOf, partsOf, withoutStatement, withStatement } from './roleDocument'

const TYPE = 'http://www.w3.org/1999/02/22-rdf-syntax-ns#type'
const ref = (name: string) => ({ '@id': `fierro:${name}` })
const GAMEPAD: Document = [
  { '@id': 'fierro:R', [TYPE]: [ref('role')], 'fierro:subject': [ref('Pad')], 'fierro:action': [ref('Drive')], 'fierro:directObject': [ref('Motors')] },
  { '@id': 'fierro:Pad', 'fierro:action': [ref('Drive')], 'fierro:data': [ref('AXES')] },
  { '@id': 'fierro:AXES', 'fierro:field': [ref('AXIS_0')] },
  {
    '@id': 'fierro:AXIS_0',
    [TYPE]: [ref('field')],
    'fierro:mapping': [ref('Port_5'), ref('Elsewhere')],
    'switchboard:resource': [{ '@value': 'robots/pad/topics/joy#/axes/0' }],
  },
  { '@id': 'fierro:Drive', 'fierro:directObject': [ref('Motors')], 'fierro:process': [ref('GamePadX')] },
  { '@id': 'fierro:GamePadX', 'fierro:port': [ref('Port_5')] },
]

describe('a document of a Role', () => {
  it('has items in the lanes of its parts, with types by properties', () => {
    const { parts, items } = partsOf(GAMEPAD)
    expect(parts).toEqual({ subject: 'Pad', action: 'Drive', directObject: 'Motors' })
    expect(items.map(({ name, type, lane }) => [name, type, lane])).toEqual([
      ['AXES', 'data', 'subject'],
      ['AXIS_0', 'field', 'subject'],
      ['GamePadX', 'process', 'action'],
      ['Port_5', 'port', 'action'],
      ['Elsewhere', 'element', null],
    ])
    expect(items[1]).toMatchObject({ resources: ['robots/pad/topics/joy#/axes/0'], mappings: ['fierro:Port_5', 'fierro:Elsewhere'] })
  })

  it('gets and loses statements', () => {
    const more = withStatement(GAMEPAD, mappingOf('fierro:AXIS_1', 'fierro:Port_5'))
    expect(partsOf(more).items.find(({ name }) => name === 'AXIS_1')?.mappings).toEqual(['fierro:Port_5'])
    expect(withoutStatement(more, mappingOf('fierro:AXIS_1', 'fierro:Port_5'))).toEqual(GAMEPAD)
    expect(withStatement(GAMEPAD, mappingOf('fierro:AXIS_0', 'fierro:Port_5'))).toBe(GAMEPAD)
    const unbound = withoutStatement(GAMEPAD, bindingOf('fierro:AXIS_0', 'robots/pad/topics/joy#/axes/0'))
    expect(partsOf(unbound).items.find(({ name }) => name === 'AXIS_0')?.resources).toEqual([])
  })

  it('is the same in the namespace of the paper, with a hash and without', () => {
    const paper = 'http://www-robot.mes.titech.ac.jp/fierro'
    const text = JSON.stringify(GAMEPAD)
      .replaceAll(/"fierro:(\w+)":/g, `"${paper}$1":`)
      .replaceAll('fierro:', `${paper}#`)
    const written = JSON.parse(text) as Document
    const { parts, items } = partsOf(written)
    expect(parts).toEqual(partsOf(GAMEPAD).parts)
    const plain = (each: (typeof items)[number]) => [each.name, each.type, each.lane, each.resources, each.mappings.map(nameOf)]
    expect(items.map(plain)).toEqual(partsOf(GAMEPAD).items.map(plain))
    const mapping = mappingOf(`${paper}#AXIS_0`, `${paper}#Port_5`)
    expect(withStatement(written, mapping)).toBe(written)
    const less = withoutStatement(written, mapping)
    expect(partsOf(less).items.find(({ name }) => name === 'AXIS_0')?.mappings).toEqual([`${paper}#Elsewhere`])
    const again = withStatement(less, mapping)
    expect(again.find((each) => `${paper}#mapping` in each)?.['@id']).toBe(`${paper}#AXIS_0`)
  })
})

it.each([
  ['robots/pad/topics/joy#/axes/0', { robot: 'pad', kind: 'topics', name: '/joy', path: 'axes[0]' }],
  ['robots/a%20b/topics/ns/cmd_vel#/linear/x', { robot: 'a b', kind: 'topics', name: '/ns/cmd_vel', path: 'linear.x' }],
  ['robots/rover/services/beep', { robot: 'rover', kind: 'services', name: '/beep', path: '' }],
  ['pipes/drive', { robot: '', kind: 'pipes', name: 'drive', path: '' }],
  ['programs/lamp/ports/power', { robot: '', kind: 'programs', name: 'lamp/ports/power', path: '' }],
])('reads %s', (text, parts) => {
  expect(boundTo(text)).toEqual({ text, ...parts })
})

it.each(['', 'rovers/x', 'robots/%E0%A4%A/topics/x'])('%s is no address', (text) => {
  expect(boundTo(text)).toBeNull()
})

it('writes addresses that it can read', () => {
  for (const [robot, topic, path] of [['a b', '/joy', 'axes[0]'], ['rover', '/ns/cmd_vel', 'linear.x'], ['rover', '/scan', '']] as const) {
    expect(boundTo(addressOf(robot, topic, path))).toMatchObject({ robot, name: topic, path })
  }
})
