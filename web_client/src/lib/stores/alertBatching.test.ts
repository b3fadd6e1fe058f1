import { afterEach, beforeEach, expect, it, vi } from 'vitest'
import { GAP_MS, AlertBatch, MOST } from './alertBatching'
import type { Alert } from '../api/types'

let announced: string[][]
let batches: AlertBatch

beforeEach(() => {
  vi.useFakeTimers()
  announced = []
  batches = new AlertBatch((batch) => announced.push(batch.map(({ id }) => id)))
})

afterEach(() => {
  vi.useRealTimers()
})

function alert(id: string, more: Partial<Alert> = {}): Alert {
  return { id, level: 'warning', state: 'open', ...more } as Alert
}

it('tells the first at once, and what comes soon after together', () => {
  batches.add([alert('a')])
  expect(announced).toEqual([['a']])
  batches.add([alert('b')])
  batches.add([])
  batches.add([alert('c'), alert('b')])
  expect(announced).toHaveLength(1)
  vi.advanceTimersByTime(GAP_MS)
  expect(announced).toEqual([['a'], ['c', 'b']])
})

it('tells one in each gap, however many come', () => {
  for (let second = 0; second < 60; second++) {
    batches.add([alert(`${second}`)])
    vi.advanceTimersByTime(1000)
  }
  vi.advanceTimersByTime(GAP_MS)
  expect(announced.length).toBeLessThanOrEqual(1 + 70_000 / GAP_MS)
  expect(announced.flat()).toHaveLength(60)
})

it('is at once again after a gap in which nothing came', () => {
  batches.add([alert('a')])
  vi.advanceTimersByTime(GAP_MS)
  batches.add([alert('b')])
  expect(announced).toEqual([['a'], ['b']])
})

it('lets nothing worse wait, but what is over', () => {
  batches.add([alert('a', { level: 'info' })])
  batches.add([alert('b', { level: 'error', state: 'over' })])
  expect(announced).toHaveLength(1)
  batches.add([alert('c', { level: 'error' })])
  expect(announced).toEqual([['a'], ['b', 'c']])
  batches.add([alert('d', { level: 'error' }), alert('e')])
  expect(announced).toHaveLength(2)
  vi.advanceTimersByTime(GAP_MS)
  expect(announced[2]).toEqual(['d', 'e'])
})

it('keeps no more than the latest', () => {
  batches.add([alert('first')])
  batches.add(Array.from({ length: MOST + 5 }, (_, i) => alert(`${i}`)))
  vi.advanceTimersByTime(GAP_MS)
  expect(announced[1]).toHaveLength(MOST)
  expect(announced[1]?.[0]).toBe('5')
})

it('tells nothing after its end', () => {
  batches.add([alert('a')])
  batches.add([alert('b')])
  batches.end()
  vi.advanceTimersByTime(GAP_MS)
  expect(announced).toEqual([['a']])
})
