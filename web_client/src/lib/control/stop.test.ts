import { afterEach, beforeEach, expect, it, vi } from 'vitest'
import { Refusal, Unreachable } from '../api/request'
import { stopByAllPaths, stopMany } from './stop'

interface Sent {
  op: string
  id: string
  service: string
  args: { stop_id: string }
}

/** Websockets that open at once, and answer what the test wants. */
class Socket {
  static all: Socket[] = []
  onopen: (() => void) | null = null
  onclose: ((event: { code: number; reason: string }) => void) | null = null
  onmessage: (event: { data: string }) => void = () => undefined
  sent: Sent[] = []
  closed = false

  constructor(readonly url: string) {
    Socket.all.push(this)
    queueMicrotask(() => this.onopen?.())
  }
  send(text: string) {
    this.sent.push(JSON.parse(text) as Sent)
  }
  close() {
    this.closed = true
  }
  answer(values: object | string, result = true) {
    this.onmessage({ data: JSON.stringify({ op: 'status', level: 'info' }) })
    this.onmessage({ data: JSON.stringify({ op: 'service_response', id: this.sent[0]!.id, result, values }) })
  }
}

const STOPPED = { success: true, done: true, message: 'stopped', stopped: {} }
let requests: { path: string; body: { stop_id: string }; signal?: AbortSignal | null }[]

/** Requests wait for ever, as in a browser whose connections are all taken. */
beforeEach(() => {
  vi.useFakeTimers()
  Socket.all = []
  requests = []
  vi.stubGlobal('WebSocket', Socket)
  vi.stubGlobal('location', { protocol: 'http:', host: 'relay' })
  vi.stubGlobal('fetch', (path: string, init: RequestInit) => {
    requests.push({ path, body: JSON.parse(String(init.body)) as { stop_id: string }, signal: init.signal })
    return new Promise((_, reject) => init.signal?.addEventListener('abort', () => reject(new TypeError('aborted'))))
  })
})

afterEach(() => {
  vi.useRealTimers()
  vi.unstubAllGlobals()
})

it('takes all paths at once, as one stop, and the first answer counts', async () => {
  const stopped = stopByAllPaths('r 1')
  await vi.advanceTimersByTimeAsync(0)
  const [socket] = Socket.all
  expect(socket!.url).toBe('ws://relay/robots/r%201')
  expect(socket!.sent[0]).toMatchObject({ op: 'call_service', service: '/relay/stop' })
  expect(requests).toMatchObject([{ path: '/api/v1/robots/r%201/stop', body: { stop_id: socket!.sent[0]!.args.stop_id } }])
  socket!.answer(STOPPED)
  expect(await stopped).toBe(false)
  // What still waits would stop the robot again later.
  expect(socket!.closed).toBe(true)
  expect(requests[0]!.signal!.aborted).toBe(true)
})

it.each([
  [{ ...STOPPED, done: false, stopped: null }, true],
  [{ success: false, done: false, message: 'the brake failed', stopped: {} }, new Refusal(409, 'the brake failed')],
  [{ success: false, done: false, message: 'no answer', stopped: null }, new Refusal(503, 'no answer')],
])('passes on how the stop ended: %j', async (values, end) => {
  const stopped = stopByAllPaths('rover').catch((error: unknown) => error)
  await vi.advanceTimersByTimeAsync(0)
  Socket.all[0]!.answer(values)
  await vi.runAllTimersAsync()
  expect(await stopped).toEqual(end)
})

it('is unanswered only when every path is', async () => {
  const stopped = stopByAllPaths('rover').catch((error: unknown) => error)
  await vi.advanceTimersByTimeAsync(0)
  Socket.all[0]!.onclose?.({ code: 1006, reason: '' })
  await vi.runAllTimersAsync()
  expect(await stopped).toBeInstanceOf(Unreachable)
})

const LINES = [
  { do: 'stop', robots: ['a', 'b'], unmatched: [] },
  { robot: 'a', ok: true, message: '', values: null, pending: false, seconds: 0.1 },
  { robot: 'b', ok: true, message: '', values: null, pending: false, seconds: 0.1 },
  { done: true, robots: 2, ok: 2, failed: 0, seconds: 0.1 },
]

it('stops all robots by both paths at once, and the first complete answer counts', async () => {
  const open: object[] = []
  const shown: number[] = []
  const all = stopMany(
    { robots: ['*'] },
    (order) => open.push(order),
    ({ results }) => shown.push(results.length),
  )
  // The open websocket takes it before any other path could fail.
  expect(open).toHaveLength(1)
  await vi.advanceTimersByTimeAsync(0)
  const [socket] = Socket.all
  expect(open).toEqual(socket!.sent)
  expect(socket!.url).toBe('ws://relay/api/v1/robots/stream')
  expect(socket!.sent[0]).toEqual({ robots: ['*'], do: 'stop', stop_id: requests[0]!.body.stop_id })
  expect(requests[0]!.path).toBe('/api/v1/fleet')
  socket!.onmessage({ data: JSON.stringify({ event: 'robots', data: { robots: [] } }) })
  for (const line of LINES) socket!.onmessage({ data: JSON.stringify({ event: 'order', data: line }) })
  const { progress, failure } = await all
  expect(failure).toBe(null)
  expect(progress).toMatchObject({ meant: ['a', 'b'], done: true })
  expect(progress.results).toHaveLength(2)
  expect(shown).toEqual([0, 1, 2, 2])
  expect(socket!.closed).toBe(true)
  expect(requests[0]!.signal!.aborted).toBe(true)
})

it('tells which robots of all are stopped when the answer breaks off', async () => {
  const all = stopMany({ robots: ['*'] })
  await vi.advanceTimersByTimeAsync(0)
  for (const line of LINES.slice(0, 2)) Socket.all[0]!.onmessage({ data: JSON.stringify({ event: 'order', data: line }) })
  Socket.all[0]!.onclose?.({ code: 1006, reason: '' })
  await vi.runAllTimersAsync()
  const { progress, failure } = await all
  expect(failure).toBeInstanceOf(Unreachable)
  expect(progress.results.map(({ robot }) => robot)).toEqual(['a'])
})

it.each([
  [4401, 'your session has ended', new Refusal(401, 'Your session has ended.')],
  [4404, 'the order matches no robot', new Refusal(403, 'The order matches no robot.')],
  [4503, '', new Unreachable()],
])('tells why no robot is stopped: %i', async (code, reason, end) => {
  const all = stopMany({ robots: ['*'] })
  await vi.advanceTimersByTimeAsync(0)
  Socket.all[0]!.onclose?.({ code, reason })
  await vi.runAllTimersAsync()
  expect((await all).failure).toEqual(end)
})
