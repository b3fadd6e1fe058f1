import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest'
import { followLog, followModules, followProcesses, ordersFor, sorted, STATES } from './modules'
import type { LogPage, ModuleList, ModuleStatus, ProcessList, ProcessStatus } from './types'

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

describe('what is followed', () => {
  const leave = new AbortController()
  const asked: string[] = []
  const accepted = new Set<string | undefined>()
  let answers: object[] = []

  /** The relay: an answer after another, the last one again and again. */
  function relay(address: string, options: { headers: Record<string, string> }): Promise<Response> {
    asked.push(address.replace('/api/v1/robots/rover', ''))
    accepted.add(options.headers['Accept'])
    return Promise.resolve(Response.json(answers.length > 1 ? answers.shift() : answers[0]))
  }

  beforeEach(() => {
    vi.useFakeTimers()
    vi.stubGlobal('fetch', relay)
    asked.length = 0
    accepted.clear()
  })

  afterEach(() => {
    vi.useRealTimers()
    vi.unstubAllGlobals()
  })

  it('is asked for by requests that end, until the page is left', async () => {
    answers = [{ modules: [{ name: 'base' }] }]
    const taken: ModuleList[] = []
    const following = followModules('rover', (list) => taken.push(list), leave.signal).catch((error: unknown) => error)
    await vi.advanceTimersByTimeAsync(3500)
    expect(taken).toHaveLength(4)
    expect([...accepted]).toEqual(['application/json'])
    leave.abort(new Error('left'))
    expect(await following).toEqual(new Error('left'))
    await vi.advanceTimersByTimeAsync(5000)
    expect(asked).toHaveLength(4)
  })

  it('is asked for less often by a user who may manage no module', async () => {
    answers = [{ modules: [] }]
    void followModules('rover', () => {}, new AbortController().signal)
    await vi.advanceTimersByTimeAsync(9000)
    expect(asked).toHaveLength(2)
  })

  it('has each line of a log once, and goes on at once behind a page that is not the last', async () => {
    const page = (next: number, ...lines: string[]) => ({ lines: lines.map((text) => ({ text })), previous: 0, next, missed: false })
    answers = [page(20, 'a'), page(30), page(40, 'b'), page(40)]
    const lines: string[] = []
    const take = (found: LogPage) => lines.push(...found.lines.map(({ text }) => text))
    void followLog('rover', 'base', 'debug', 10, take, new AbortController().signal)
    await vi.advanceTimersByTimeAsync(500)
    expect(lines).toEqual(['a', 'b'])
    expect(asked.map((address) => address.replace(/.*after=/, ''))).toEqual(['10', '20', '30', '40'])
  })

  it('has the shares of a CPU between two measurements', async () => {
    const first = { ...row(1, 'daemon', null), busy: 10, read_at: 100 }
    const later = { ...first, busy: 10.25, read_at: 100.5 }
    const other = { ...later, created: 7 }
    answers = [{ processes: [first] }, { processes: [later] }, { processes: [other] }]
    const shares: (number | null | undefined)[] = []
    void followProcesses('rover', 0.5, (list: ProcessList) => shares.push(list.processes[0]?.cpu), new AbortController().signal)
    await vi.advanceTimersByTimeAsync(1200)
    expect(shares).toEqual([null, 50, null])
  })
})
