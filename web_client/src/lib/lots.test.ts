import { afterEach, beforeEach, expect, it, vi } from 'vitest'
import type { Alert } from './alerts'
import { GAP_MS, Lots, MOST } from './lots'

let told: string[][]
let lots: Lots

beforeEach(() => {
  vi.useFakeTimers()
  told = []
  lots = new Lots((lot) => told.push(lot.map(({ id }) => id)))
})

afterEach(() => {
  vi.useRealTimers()
})

function alert(id: string, more: Partial<Alert> = {}): Alert {
  return { id, level: 'warning', state: 'open', ...more } as Alert
}

it('tells the first at once, and what comes soon after together', () => {
  lots.add([alert('a')])
  expect(told).toEqual([['a']])
  lots.add([alert('b')])
  lots.add([])
  lots.add([alert('c'), alert('b')])
  expect(told).toHaveLength(1)
  vi.advanceTimersByTime(GAP_MS)
  expect(told).toEqual([['a'], ['c', 'b']])
})

it('tells one in each gap, however many come', () => {
  for (let second = 0; second < 60; second++) {
    lots.add([alert(`${second}`)])
    vi.advanceTimersByTime(1000)
  }
  vi.advanceTimersByTime(GAP_MS)
  expect(told.length).toBeLessThanOrEqual(1 + 70_000 / GAP_MS)
  expect(told.flat()).toHaveLength(60)
})

it('is at once again after a gap in which nothing came', () => {
  lots.add([alert('a')])
  vi.advanceTimersByTime(GAP_MS)
  lots.add([alert('b')])
  expect(told).toEqual([['a'], ['b']])
})

it('lets nothing worse wait, but what is over', () => {
  lots.add([alert('a', { level: 'info' })])
  lots.add([alert('b', { level: 'error', state: 'over' })])
  expect(told).toHaveLength(1)
  lots.add([alert('c', { level: 'error' })])
  expect(told).toEqual([['a'], ['b', 'c']])
  lots.add([alert('d', { level: 'error' }), alert('e')])
  expect(told).toHaveLength(2)
  vi.advanceTimersByTime(GAP_MS)
  expect(told[2]).toEqual(['d', 'e'])
})

it('keeps no more than the latest', () => {
  lots.add([alert('first')])
  lots.add(Array.from({ length: MOST + 5 }, (_, i) => alert(`${i}`)))
  vi.advanceTimersByTime(GAP_MS)
  expect(told[1]).toHaveLength(MOST)
  expect(told[1]?.[0]).toBe('5')
})

it('tells nothing after its end', () => {
  lots.add([alert('a')])
  lots.add([alert('b')])
  lots.end()
  vi.advanceTimersByTime(GAP_MS)
  expect(told).toEqual([['a']])
})
