import { expect, it } from 'vitest'
import { endText, type PipeForm, pipeOf } from './pipes'

const FORM: PipeForm = { name: 'scan', sourceRobot: 'one', sourceTopic: ' /scan ', targetRobot: 'two', targetTopic: '/scan', fields: '', rate: null }

it('makes a pipe of whole messages', () => {
  expect(pipeOf(FORM)).toEqual({
    name: 'scan',
    source: { robot: 'one', topic: '/scan' },
    target: { robot: 'two', topic: '/scan' },
    fields: [],
    rate: 0,
  })
})

it('reads fields, one a line', () => {
  const found = pipeOf({ ...FORM, fields: 'axes[1] = linear.x * -0.5\n\naxes[0]=angular.z+1', rate: 5 })
  expect(found).toMatchObject({
    rate: 5,
    fields: [
      { source: 'axes[1]', target: 'linear.x', scale: -0.5, offset: 0 },
      { source: 'axes[0]', target: 'angular.z', scale: 1, offset: 1 },
    ],
  })
})

it('takes a name with () as a service', () => {
  const found = pipeOf({ ...FORM, targetTopic: '/lamp/switch()' })
  expect(found).toMatchObject({ target: { robot: 'two', service: '/lamp/switch' } })
  expect(endText({ robot: 'two', service: '/lamp/switch' })).toBe('two:/lamp/switch()')
  expect(endText({ robot: 'two', topic: '/scan', service: '' })).toBe('two:/scan')
})

it('takes a name with {} as an action', () => {
  const found = pipeOf({ ...FORM, targetTopic: '/dock{}' })
  expect(found).toMatchObject({ target: { robot: 'two', action: '/dock' } })
  expect(endText({ robot: 'two', topic: '', service: '', action: '/dock' })).toBe('two:/dock{}')
})

it('takes ports and functions of programs, which need no robot', () => {
  const port = 'programs/lamp/ports/power'
  const found = pipeOf({ ...FORM, sourceRobot: '', sourceTopic: port })
  expect(found).toMatchObject({ source: { program: 'lamp', port: 'power' }, target: { robot: 'two', topic: '/scan' } })
  expect(endText({ program: 'lamp', port: 'power' })).toBe(port)
  expect(endText({ robot: '', topic: '', program: 'lamp', port: '', function: 'blink' })).toBe('programs/lamp/functions/blink')
})

it.each([
  [{ name: 'Scan' }, 'A name begins'],
  [{ targetRobot: '' }, 'Choose both'],
  [{ sourceTopic: 'scan' }, 'Topics begin'],
  [{ fields: 'axes' }, 'is no field'],
])('says what is wrong with %j', (change, words) => {
  expect(pipeOf({ ...FORM, ...change })).toContain(words)
})
