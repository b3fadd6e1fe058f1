import { afterEach, beforeEach, expect, it, vi } from 'vitest'
import { Refusal, Unreachable } from '../api/request'
import { stopAll, stopByAllPaths, UNANSWERED_MS } from './stop'

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

it('stops robots one by one when the order to all gets no answer within a second', async () => {
  const names: string[] = []
  const all = stopAll(['a', 'b'], () => undefined, (name) => names.push(name)).catch((error: unknown) => error)
  await vi.advanceTimersByTimeAsync(UNANSWERED_MS - 1)
  expect(Socket.all).toEqual([])
  await vi.advanceTimersByTimeAsync(1)
  expect(Socket.all.map(({ url }) => url)).toEqual(['ws://relay/robots/a', 'ws://relay/robots/b'])
  expect(Socket.all[1]!.sent[0]!.args.stop_id).toBe(requests[0]!.body.stop_id)
  Socket.all[1]!.answer(STOPPED)
  await vi.runAllTimersAsync()
  expect(await all).toBeInstanceOf(Unreachable)
  expect(names).toEqual(['b'])
})
