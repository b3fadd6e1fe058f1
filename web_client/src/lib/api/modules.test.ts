import { describe, expect, it } from 'vitest'
import { ordersFor, sorted, STATES } from './modules'
import type { ModuleStatus, ProcessStatus } from './types'

const row = (pid: number, part: string, cpu: number | null): ProcessStatus => ({
  pid,
  parent: 1,
  name: 'python3',
  part,
  state: 'sleeping',
  busy: 0,
  read_at: 0,
  cpu,
  cpu_number: 0,
  nice: 0,
  threads: 1,
  voluntary: 0,
  involuntary: 0,
  created: 0,
  memory: 0,
})

describe('sorted', () => {
  const rows = [row(3, 'base', 1), row(1, 'daemon', null), row(2, 'base', 9)]
  const pids = (found: ProcessStatus[]) => found.map(({ pid }) => pid)

  it('has the largest number first, and what is not known last', () => {
    expect(pids(sorted(rows, 'cpu', false))).toEqual([2, 3, 1])
    expect(pids(sorted(rows, 'cpu', true))).toEqual([1, 3, 2])
  })

  it('has text in alphabetical order, then by process', () => {
    expect(pids(sorted(rows, 'part', false))).toEqual([2, 3, 1])
    const running = { ...row(4, 'base', 0), state: 'running' }
    expect(pids(sorted([...rows, running], 'state', false))).toEqual([4, 1, 2, 3])
  })
})

describe('ordersFor', () => {
  const module = (state: string, more: object = {}) => ({ name: 'base', state, wanted: true, pending: null, ...more }) as ModuleStatus

  it.each([
    ['stopped', ['start']],
    ['waiting', ['stop']],
    ['starting', ['stop', 'restart']],
    ['running', ['stop', 'restart']],
    ['backing_off', ['start', 'stop']],
    ['failed', ['start', 'stop']],
    ['unknown', ['start', 'stop']],
    ['stopping', ['stop']],
  ])('has the orders that change something in the state %s', (state, orders) => {
    expect(ordersFor(module(state))).toEqual(orders)
  })

  it('knows each state that is shown', () => {
    for (const state of Object.keys(STATES)) expect(ordersFor(module(state))).not.toEqual([])
  })

  it('starts a module again that is being stopped', () => {
    expect(ordersFor(module('stopping', { wanted: false }))).toEqual(['start'])
  })

  it('has the opposite of a pending order', () => {
    const pending = (action: string) => ({ pending: { action, by: 'ann', at: 0 } })
    expect(ordersFor(module('running', pending('stop')))).toEqual(['start'])
    expect(ordersFor(module('failed', pending('start')))).toEqual(['stop'])
  })
})
