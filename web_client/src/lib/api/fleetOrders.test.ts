import { describe, expect, it } from 'vitest'
import { after, Lines, NOTHING_YET, missedWords, orderOf, stopEnd, table, targets, unmatchedWords } from './fleetOrders'
import type { Order, OrderKind } from './types'

const ANSWER =
  '{"do":"stop","robots":["a","b"],"unmatched":[]}\n{"robot":"b","ok":true,"message":"","values":null,"pending":true,"seconds":0.1}\n' +
  '{"robot":"a","ok":false,"message":"no","values":null,"pending":false,"seconds":1}\n' +
  '{"done":true,"robots":2,"ok":1,"failed":1,"seconds":1}\n'

describe('the answer', () => {
  it.each([1, 7, 1000])('is read in pieces of %d characters', (size) => {
    const lines = new Lines()
    let progress = NOTHING_YET
    for (let i = 0; i < ANSWER.length; i += size) {
      for (const line of lines.take(ANSWER.slice(i, i + size))) progress = after(progress, line)
    }
    expect(progress.done).toBe(true)
    expect(progress.meant).toEqual(['a', 'b'])
    expect(table(progress).map(({ robot, result }) => [robot, result?.ok])).toEqual([
      ['a', false],
      ['b', true],
    ])
  })

  it('that breaks off is not whole, and tells of whom nothing is known', () => {
    const lines = new Lines()
    const progress = lines.take(ANSWER.split('\n').slice(0, 2).join('\n') + '\n{"robot":"a"').reduce(after, NOTHING_YET)
    expect(progress.done).toBe(false)
    expect(table(progress).map(({ result }) => result === null)).toEqual([true, false])
  })

  it('tells what of the order means no robot', () => {
    const words = (unmatched: string[]) => unmatchedWords(after(NOTHING_YET, { do: 'stop', robots: ['a'], unmatched }))
    expect(words(['rovr-2'])).toBe('None of your robots matches rovr-2.')
    expect(words(['b', 'group:c'])).toBe('None of your robots matches b, group:c.')
    expect(words([])).toBe('')
  })

  it('passes over what it does not know', () => {
    const found = new Lines().take('\n[1]\nnonsense\n3\n{"new":1}\n')
    expect(found.reduce(after, NOTHING_YET)).toEqual(NOTHING_YET)
  })
})

it('takes names apart as people write them, each once', () => {
  expect(targets(' a, b*  group:cleaners\na ')).toEqual(['a', 'b*', 'group:cleaners'])
})

describe('the form', () => {
  const form = { do: 'call', name: ' /start ', type: '', body: '', why: '', action: 'start' } as const

  it('makes an order of each kind', () => {
    expect(orderOf(['a'], form)).toEqual({ robots: ['a'], do: 'call', service: '/start', args: {} })
    expect(orderOf(['a'], { ...form, do: 'stop', why: ' fire ' })).toEqual({ robots: ['a'], do: 'stop', why: 'fire' })
    expect(orderOf(['a'], { ...form, do: 'publish', type: 'std_msgs/Empty' })).toMatchObject({
      topic: '/start',
      type: 'std_msgs/Empty',
      msg: {},
    } satisfies Partial<Order>)
    expect(orderOf(['a'], { ...form, do: 'set', body: '"fast"' })).toMatchObject({ name: '/start', value: 'fast' })
    expect(orderOf(['a'], { ...form, do: 'module', name: 'cleaning', action: 'restart' })).toEqual({
      robots: ['a'],
      do: 'module',
      module: 'cleaning',
      action: 'restart',
    })
  })

  it.each<[OrderKind, string[]]>([
    ['stop', ['why']],
    ['resume', ['why']],
    ['call', ['args', 'service', 'type', 'why']],
    ['publish', ['msg', 'topic', 'type']],
    ['set', ['name', 'value']],
    ['module', ['action', 'module']],
  ])('sends with %s what goes with it, whatever was typed for another', (kind, fields) => {
    const typed = { do: kind, name: '/it', type: 'std_msgs/Empty', body: '{"a": 1}', why: 'wet floor', action: 'stop' } as const
    const order = orderOf(['a'], typed)
    expect(Object.keys(order).sort()).toEqual(['do', 'robots', ...fields].sort())
  })

  it('says what is missing', () => {
    expect(orderOf([], form)).toContain('Choose robots')
    expect(orderOf(['a'], { ...form, name: ' ' })).toBe('Which service?')
    expect(orderOf(['a'], { ...form, body: '{' })).toBe('This is not JSON.')
    expect(orderOf(['a'], { ...form, do: 'set' })).toBe('Which value?')
  })
})

describe('how much one order may mean', () => {
  const stop = { do: 'stop', name: '', type: '', body: '', why: '', action: 'start' } as const
  const many = (count: number, what = (i: number) => `rover-${i}`) => Array.from({ length: count }, (_, i) => what(i))

  it('is a thousand names: all that a page shows', () => {
    expect(orderOf(many(1000), stop)).toEqual({ robots: many(1000), do: 'stop' })
    expect(orderOf(many(1001), stop)).toContain('At most 1000 names')
  })

  it.each([(i: number) => `rover-${i}*`, (i: number) => `r?${i}`, (i: number) => `r[${i}]`, (i: number) => `group:${i}`])(
    'is 64 patterns and groups: %s',
    (what) => {
      expect(orderOf([...many(64, what), ...many(100)], stop)).toMatchObject({ do: 'stop' })
      expect(orderOf(many(65, what), stop)).toContain('At most 64 patterns and groups')
    },
  )
})

describe('what became of a stop', () => {
  const result = (robot: string, ok: boolean, pending = false) => ({ robot, ok, message: '', values: null, pending, seconds: 0 })
  const end = (missed: string, ...results: ReturnType<typeof result>[]) =>
    stopEnd({ ...NOTHING_YET, meant: ['a', 'b'], missed, results, done: true })

  it('is who is stopped, and who will be, for a moment', () => {
    expect(end('', result('a', true), result('b', true))).toEqual({ kind: 'info', words: '2 robots are stopped.', until: null })
    expect(end('', result('a', true), result('b', true, true)).words).toBe(
      '1 robot is stopped. 1 robot is offline, and will be stopped when back.',
    )
  })

  it('is who may not be, until he is', () => {
    const words = expect.stringContaining('Not confirmed to be stopped: b.') as string
    expect(end('', result('a', true), result('b', false))).toEqual({ kind: 'error', words, until: ['b'] })
    expect(end('', result('a', true))).toEqual({ kind: 'error', words, until: ['b'] })
  })

  it('is not all, where the relay could not look up all', () => {
    const words = expect.stringContaining('2 robots are stopped. Other robots of yours may be missing in this order. No answer.') as string
    expect(end('no answer', result('a', true), result('b', true))).toEqual({ kind: 'error', words, until: [] })
    expect(end('no answer', result('a', true))).toMatchObject({ kind: 'error', until: [] })
    const progress = after(NOTHING_YET, { do: 'stop', robots: ['a'], unmatched: [], missed: 'no answer' })
    expect(missedWords(progress)).toContain('No answer.')
    expect(missedWords(after(NOTHING_YET, { do: 'stop', robots: ['a'], unmatched: [] }))).toBe('')
  })

  it('is not known where the answer ends before it began', () => {
    const { kind, words, until } = stopEnd(NOTHING_YET)
    expect([kind, until]).toEqual(['error', []])
    expect(words).toContain('It is unknown which robots are stopped')
    expect(words).toContain('Press STOP again')
  })
})
