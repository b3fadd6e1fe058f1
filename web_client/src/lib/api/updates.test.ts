import { afterEach, beforeEach, expect, it, vi } from 'vitest'
import { fleetStream } from './api'
import { DEAD_MS, SILENT_MS, Stream } from './updates'

class Socket {
  static all: Socket[] = []
  onmessage: ((event: { data: string }) => void) | null = null
  onclose: ((event: { reason: string }) => void) | null = null
  closed = false

  constructor(readonly url: string) {
    Socket.all.push(this)
  }
  close(): void {
    this.closed = true
  }
  says(event: string, data: unknown = {}): void {
    this.onmessage?.({ data: JSON.stringify({ event, data }) })
  }
  static get last(): Socket {
    return Socket.all.at(-1)!
  }
}

const received = vi.fn<(event: string, data: unknown) => void>()
const silent = vi.fn<(ms: number) => void>()
const gone = vi.fn<(why: string) => void>()
let stream: Stream

beforeEach(() => {
  vi.useFakeTimers()
  vi.stubGlobal('WebSocket', Socket)
  vi.spyOn(Math, 'random').mockReturnValue(0.5)
  Socket.all = []
  stream = new Stream('ws://relay/stream', { received, silent, gone })
  stream.open()
})

afterEach(() => {
  stream.close()
  vi.useRealTimers()
  vi.unstubAllGlobals()
  vi.restoreAllMocks()
  for (const each of [received, silent, gone]) each.mockClear()
})

it('hands on what is told', () => {
  Socket.last.says('robots', { robots: [] })
  expect(received).toHaveBeenCalledWith('robots', { robots: [] })
})

it('is content while something comes every five seconds', () => {
  for (let i = 0; i < 20; i++) {
    vi.advanceTimersByTime(5000)
    Socket.last.says('unknown')
  }
  expect(silent).not.toHaveBeenCalled()
  expect(Socket.all).toHaveLength(1)
})

it('says that nothing comes, and dials again', () => {
  Socket.last.says('robots')
  vi.advanceTimersByTime(SILENT_MS - 1000)
  expect(silent).not.toHaveBeenCalled()
  vi.advanceTimersByTime(1000)
  expect(silent).toHaveBeenCalledOnce()
  expect(gone).not.toHaveBeenCalled()
  vi.advanceTimersByTime(DEAD_MS - SILENT_MS)
  expect(gone).toHaveBeenCalledExactlyOnceWith('')
  expect(Socket.all[0]!.closed).toBe(true)
  vi.advanceTimersByTime(500)
  expect(Socket.all).toHaveLength(2)
})

it('gives a handshake that nobody answers no more time', () => {
  vi.advanceTimersByTime(DEAD_MS + 500)
  expect(Socket.all).toHaveLength(2)
})

it('hears nothing more of what it has given up', () => {
  const first = Socket.last
  vi.advanceTimersByTime(DEAD_MS + 500)
  first.says('robots')
  first.onclose?.({ reason: '' })
  expect(received).not.toHaveBeenCalled()
  expect(gone).toHaveBeenCalledOnce()
})

it('waits longer after each attempt, until something is told', () => {
  for (const ms of [500, 1000, 2000, 4000]) {
    Socket.last.onclose?.({ reason: 'the relay is going down' })
    const before = Socket.all.length
    vi.advanceTimersByTime(ms - 1)
    expect(Socket.all).toHaveLength(before)
    vi.advanceTimersByTime(1)
    expect(Socket.all).toHaveLength(before + 1)
  }
  expect(gone).toHaveBeenLastCalledWith('the relay is going down')
  Socket.last.says('robots')
  Socket.last.onclose?.({ reason: '' })
  vi.advanceTimersByTime(500)
  expect(Socket.all).toHaveLength(6)
})

it('tries at once when asked to, but never twice at a time', () => {
  stream.retryNow()
  expect(Socket.all).toHaveLength(1)
  Socket.last.onclose?.({ reason: '' })
  stream.retryNow()
  expect(Socket.all).toHaveLength(2)
  vi.advanceTimersByTime(1000)
  expect(Socket.all).toHaveLength(2)
})

it('does not take a page that slept for a relay that is lost', () => {
  Socket.last.says('robots')
  // The clock went on while no timer fired.
  const now = performance.now()
  vi.spyOn(performance, 'now').mockImplementation(() => now + 60_000)
  vi.advanceTimersByTime(1000)
  expect(silent).not.toHaveBeenCalled()
  Socket.last.says('robots')
  vi.advanceTimersByTime(1000)
  expect(silent).not.toHaveBeenCalled()
})

it('notices silence also where the browser lets a hidden page look but once a minute', () => {
  Socket.last.says('robots')
  let now = performance.now()
  vi.spyOn(performance, 'now').mockImplementation(() => now)
  for (let minute = 0; minute < 2; minute++) {
    now += 60_000
    vi.advanceTimersByTime(1000)
  }
  expect(gone).toHaveBeenCalledOnce()
})

it('ends when it is closed', () => {
  const first = Socket.last
  stream.close()
  expect(first.closed).toBe(true)
  vi.advanceTimersByTime(60_000)
  expect(Socket.all).toHaveLength(1)
  expect(silent).not.toHaveBeenCalled()
})

it.each([
  [{ protocol: 'https:', host: 'relay:9090' }, 'wss://relay:9090/api/v1/robots/stream'],
  [{ protocol: 'http:', host: 'h' }, 'ws://h/api/v1/robots/stream'],
])('tells a fleet what is said of it, from %o', (page, url) => {
  const watcher = { robots: vi.fn(), alerts: vi.fn(), unknown: vi.fn(), silent: vi.fn(), gone: vi.fn() }
  const fleet = fleetStream(watcher, page)
  fleet.open()
  expect(Socket.last.url).toBe(url)
  Socket.last.says('robots', { robots: [{ name: 'rover' }] })
  Socket.last.says('alerts', { alerts: [] })
  Socket.last.says('unknown', { reason: 'the database does not answer' })
  Socket.last.says('something new', {})
  Socket.last.onclose?.({ reason: 'the relay is going down' })
  expect(watcher.robots).toHaveBeenCalledExactlyOnceWith([{ name: 'rover' }])
  expect(watcher.alerts).toHaveBeenCalledExactlyOnceWith([])
  expect(watcher.unknown).toHaveBeenCalledExactlyOnceWith('The database does not answer.')
  expect(watcher.gone).toHaveBeenCalledExactlyOnceWith('The relay is going down.')
  fleet.close()
})
