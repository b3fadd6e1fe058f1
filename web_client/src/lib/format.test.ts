import { describe, expect, it } from 'vitest'
import {
  ago,
  bytesPerSecond,
  count,
  fileSize,
  hertz,
  lasting,
  milliseconds,
  moment,
  timeOfDay,
  number,
  people,
  percent,
  pretty,
  sentence,
  stopwatch,
} from './format'

it('writes numbers with a real minus and without a negative zero', () => {
  expect(number(-1.234, 2)).toBe('−1.23')
  expect(number(-0.001, 2)).toBe('0.00')
  expect(number(null, 2)).toBe('–')
  expect(number(Number.NaN, 2)).toBe('–')
})

it('writes times, shares and rates', () => {
  expect([0.4, 41.6, null].map(milliseconds)).toEqual(['< 1 ms', '42 ms', '–'])
  expect([0.256, 1.4, null].map(percent)).toEqual(['26 %', '100 %', '–'])
  expect([0, 9.94, 29.7].map(hertz)).toEqual(['0 Hz', '9.9 Hz', '30 Hz'])
})

it('says how long ago something was', () => {
  const now = 1_000_000
  expect([now - 2, now - 40, now - 150, now - 7300, now - 90_000, now - 400_000].map((t) => ago(t, now))).toEqual([
    'just now',
    '40 s ago',
    '2 min ago',
    '2 h ago',
    'a day ago',
    '4 days ago',
  ])
  expect(ago(null, now)).toBe('never')
  expect([now - 2, now - 40, now - 90_000].map((t) => lasting(t, now))).toEqual(['a moment', '40 s', 'a day'])
})

it('names people once, and few of them', () => {
  expect(people([])).toBe('nobody')
  expect(people(['ann', 'ann'])).toBe('ann')
  expect(people(['ann', 'bob', 'cid', 'dot'])).toBe('ann, bob and 2 more')
})

it('makes sentences of remarks', () => {
  expect(['no such robot', 'Wait.', '  ', 'why?'].map(sentence)).toEqual(['No such robot.', 'Wait.', '', 'Why?'])
})

describe('pretty', () => {
  it('indents like JSON', () => {
    const message = { a: 1, b: { c: [1, 2], d: 'x' }, e: [], f: {} }
    expect(JSON.parse(pretty(message))).toEqual(message)
    expect(pretty({ a: [1, 2] })).toBe('{\n  "a": [1, 2]\n}')
  })

  it('cuts long arrays and names the rest', () => {
    expect(pretty({ ranges: Array.from({ length: 360 }, (_, i) => i) })).toContain('[0, 1, 2, 3, 4, 5, … 354 more]')
    expect(pretty(Array.from({ length: 9 }, () => ({ a: 1 })))).toContain('… 3 more')
  })

  it('cuts long strings and tells their length', () => {
    const text = pretty({ data: 'A'.repeat(40_000) })
    expect(text).toContain('40000 characters')
    expect(text.length).toBeLessThan(300)
  })

  it('bounds the number of lines and the depth', () => {
    const wide = Object.fromEntries(Array.from({ length: 5000 }, (_, i) => [`k${i}`, { v: i }]))
    expect(pretty(wide).split('\n').length).toBeLessThanOrEqual(401)
    let deep: unknown = 1
    for (let i = 0; i < 5000; i++) deep = { deep }
    expect(pretty(deep).split('\n').length).toBeLessThan(100)
  })
})

it('writes amounts per second in units people read', () => {
  expect(bytesPerSecond(0)).toBe('0 kB/s')
  expect(bytesPerSecond(312_400)).toBe('312 kB/s')
  expect(bytesPerSecond(1_260_000)).toBe('1.3 MB/s')
  expect(bytesPerSecond(25_000_000)).toBe('25 MB/s')
})

it('writes sizes, spans and large numbers', () => {
  expect([0, 999, 1000, 1_234_567, 100e6, 999_960_000, 10e9].map(fileSize)).toEqual([
    '0 B',
    '999 B',
    '1 kB',
    '1.2 MB',
    '100 MB',
    '1 GB',
    '10 GB',
  ])
  expect([0, 42.9, 725, 3723, 86_400].map(stopwatch)).toEqual(['0:00', '0:42', '12:05', '1:02:03', '24:00:00'])
  expect([7, 1234, 1_234_567].map(count)).toEqual(['7', '1\u202f234', '1\u202f234\u202f567'])
})

it('names the date of a time only where it is another day', () => {
  const then = Date.UTC(2026, 5, 15, 12) / 1000
  expect(timeOfDay(then, then + 60)).not.toMatch(/Jun|15/)
  expect(timeOfDay(then, then + 3 * 86_400)).toMatch(/15/)
})

it('names the year only where it is another one', () => {
  const [then, later] = [Date.UTC(2026, 5, 15) / 1000, Date.UTC(2027, 5, 15) / 1000]
  expect(moment(then, then)).not.toContain('2026')
  expect(moment(then, later)).toContain('2026')
})
