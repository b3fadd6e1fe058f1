import { describe, expect, it } from 'vitest'
import { fieldsOf, inRosNames, messageWith, misfit, parsed, short, type TypeDef, typeAt, valueAt } from './fields'

function typeDef(type: string, fields: [string, string, number?][]): TypeDef {
  return {
    type,
    fieldnames: fields.map(([name]) => name),
    fieldtypes: fields.map(([, inner]) => inner),
    fieldarraylen: fields.map(([, , length]) => length ?? -1),
  }
}

const TWIST = [
  typeDef('Twist', [['linear', 'Vector3'], ['angular', 'Vector3']]),
  typeDef('Vector3', [['x', 'float64'], ['y', 'float64'], ['z', 'float64']]),
]
const JOY = [
  typeDef('Joy', [['axes', 'float32', 0], ['pair', 'Pair', 2], ['data', 'uint8', 0]]),
  typeDef('Pair', [['name', 'string']]),
]

describe('fields of messages', () => {
  it('are listed with their basic types', () => {
    expect(fieldsOf(TWIST).map(({ path }) => path)).toEqual(['linear.x', 'linear.y', 'linear.z', 'angular.x', 'angular.y', 'angular.z'])
    expect(fieldsOf(TWIST)[0]).toEqual({ path: 'linear.x', type: 'float64', indexed: false })
    expect(fieldsOf([])).toEqual([])
  })

  it('in lists are those of the newest message; bytes are left out', () => {
    expect(fieldsOf(JOY).map(({ path }) => path)).toEqual(['pair[0].name', 'pair[1].name'])
    const found = fieldsOf(JOY, { axes: [0.5, 1], data: [1] })
    expect(found.map(({ path }) => path)).toEqual(['axes[0]', 'axes[1]', 'pair[0].name', 'pair[1].name'])
    expect(found.every(({ indexed }) => indexed)).toBe(true)
  })

  it('of a type that contains itself end', () => {
    expect(fieldsOf([typeDef('Loop', [['inner', 'Loop']])])).toEqual([])
  })

  it.each([
    [TWIST, 'linear.x', 'float64'],
    [JOY, 'axes[3]', 'float32'],
    [JOY, 'pair[0].name', 'string'],
    [TWIST, 'linear.w', null],
    [[], 'data', null],
  ])('have a basic type by their path', (definitions, path, type) => {
    expect(typeAt(definitions, path)).toBe(type)
  })

  it.each([
    ['', { a: 1 }],
    ['list[1]', 4],
    ['inner.x', true],
    ['inner.y', undefined],
    ['nothing.at.all', undefined],
  ])('%s is read from a message', (path, value) => {
    expect(valueAt(path === '' ? { a: 1 } : { list: [3, 4], inner: { x: true } }, path)).toEqual(value)
  })

  it('are set in a message of their own', () => {
    expect(messageWith('linear.x', 0.5)).toEqual({ linear: { x: 0.5 } })
    expect(messageWith('', { data: 1 })).toEqual({ data: 1 })
    expect(messageWith('axes[0]', 1)).toBeNull()
  })
})

it.each([
  ['float32', 'float64', false, null],
  ['bool', 'int32', false, null],
  ['float64', 'string', false, null],
  ['int8', 'bool', false, null],
  ['string', 'float64', false, 'a is text and b is a number.'],
  ['string', 'bool', false, 'a is text and b is yes or no.'],
  ['float64', 'float64', true, 'b is a value in a list'],
])('values of %s to %s', (source, target, indexed, words) => {
  const found = misfit({ path: 'a', type: source }, { path: 'b', type: target, indexed })
  if (words === null) expect(found).toBeNull()
  else expect(found).toContain(words)
})

it.each([
  ['0.5', 'float64', 0.5],
  ['0,5', 'float64', 0.5],
  ['on', 'bool', true],
  ['no', 'bool', false],
  ['7', 'string', '7'],
  ['{"data": 1}', null, { data: 1 }],
  ['hello', null, 'hello'],
])('%s typed for %s', (text, type, value) => {
  expect(parsed(text, type)).toEqual(value)
})

it.each([
  ['fast', 'float64'],
  ['', 'int32'],
  ['maybe', 'bool'],
  ['{x: 1}', null],
])('%s is refused for %s', (text, type) => {
  expect(() => parsed(text, type)).toThrow(/no number|neither|no JSON/)
})

it('has the names of types that ROS uses', () => {
  expect(inRosNames([typeDef('A', [['a', 'double'], ['b', 'boolean'], ['c', 'int32']])])[0]?.fieldtypes).toEqual(['float64', 'bool', 'int32'])
})

it('shows values shortly', () => {
  expect([undefined, 0.123456, 7, true, 'text', [1, 2], { data: 0.5 }].map(short)).toEqual(['–', '0.1235', '7', 'true', 'text', '[1,2]', '0.5'])
  expect(short('x'.repeat(60))).toHaveLength(40)
})
