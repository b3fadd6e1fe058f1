import { afterEach, beforeEach, expect, it, vi } from 'vitest'
import type { Ending } from '../api/closeCodes'
import { Link, type LinkState, type RelayMessage } from './robotLink'

interface Sent {
  op: string
  id: string
  [key: string]: unknown
}

/** A websocket whose other end is the test. */
class FakeSocket {
  static readonly CONNECTING = 0
  static readonly OPEN = 1
  static readonly CLOSING = 2
  static readonly CLOSED = 3
  static all: FakeSocket[] = []
  readyState = FakeSocket.CONNECTING
  bufferedAmount = 0
  sent: Sent[] = []
  onopen: (event: object) => void = () => {}
  onclose: (event: object) => void = () => {}
  onerror: (event: object) => void = () => {}
  onmessage: (event: object) => void = () => {}

  constructor(readonly url: string) {
    FakeSocket.all.push(this)
  }
  send(text: string): void {
    this.sent.push(JSON.parse(text) as Sent)
  }
  close(): void {
    this.readyState = FakeSocket.CLOSING
  }
  accept(): void {
    this.readyState = FakeSocket.OPEN
    this.onopen({})
  }
  end(code: number, reason = ''): void {
    this.readyState = FakeSocket.CLOSED
    this.onclose({ code, reason })
  }
  say(message: object): void {
    this.onmessage({ data: JSON.stringify(message) })
  }
  ops(op: string): Sent[] {
    return this.sent.filter((message) => message.op === op)
  }
}

let states: [LinkState, Ending | null][]
let received: RelayMessage[]
let link: Link

const latest = () => FakeSocket.all.at(-1)!

async function opened(): Promise<FakeSocket> {
  await vi.advanceTimersByTimeAsync(0)
  latest().accept()
  return latest()
}

beforeEach(() => {
  vi.useFakeTimers()
  vi.stubGlobal('WebSocket', FakeSocket)
  FakeSocket.all = []
  states = []
  received = []
  link = new Link('ws://relay/robots/r1', {
    state: (state, why) => states.push([state, why]),
    received: (message) => received.push(message),
  })
  link.connect()
})

afterEach(() => {
  link.close()
  vi.useRealTimers()
  vi.unstubAllGlobals()
})

it('asks for warnings in words as soon as it is open', async () => {
  const socket = await opened()
  expect(socket.sent[0]).toMatchObject({ op: 'set_level', level: 'warning' })
  socket.say({ op: 'status', level: 'error', msg: 'not allowed', id: 'publish:/x:1' })
  socket.say({ op: 'status', level: 'warning', msg: 'slow' })
  socket.say({ op: 'status', level: 'error', msg: 'the relay is going down', id: 'closed' })
  expect(received).toEqual([
    { level: 'error', words: 'not allowed' },
    { level: 'warning', words: 'slow' },
  ])
})

it('publishes nothing, and keeps nothing for later, while it is not open', async () => {
  expect(link.publish('/cmd_vel', 'geometry_msgs/msg/Twist', {})).toBe(false)
  const first = await opened()
  expect(first.ops('publish')).toEqual([])
  first.end(1006)
  for (let i = 0; i < 5; i++) expect(link.publish('/cmd_vel', 'geometry_msgs/msg/Twist', {})).toBe(false)
  await vi.advanceTimersByTimeAsync(20_000)
  const second = await opened()
  expect(second).not.toBe(first)
  expect(second.ops('publish')).toEqual([])
  expect(link.publish('/cmd_vel', 'geometry_msgs/msg/Twist', { a: 1 })).toBe(true)
  expect(second.ops('advertise')).toHaveLength(1)
  expect(second.ops('publish')).toMatchObject([{ topic: '/cmd_vel', msg: { a: 1 } }])
})

it('publishes nothing on a socket that is closing', async () => {
  const socket = await opened()
  socket.readyState = FakeSocket.CLOSING
  expect(link.publish('/cmd_vel', 'geometry_msgs/msg/Twist', {})).toBe(false)
})

it('subscribes again after a reconnect, each topic once', async () => {
  const got: unknown[] = []
  const leave = link.subscribe('/odom', 'nav_msgs/msg/Odometry', (message) => got.push(message), 66)
  const first = await opened()
  expect(first.ops('subscribe')).toMatchObject([{ topic: '/odom', throttle_rate: 66, queue_length: 1 }])
  first.say({ op: 'publish', topic: '/odom', msg: 1 })
  first.end(1001)
  await vi.advanceTimersByTimeAsync(20_000)
  const second = await opened()
  expect(second.ops('subscribe')).toHaveLength(1)
  second.say({ op: 'publish', topic: '/odom', msg: 2 })
  expect(got).toEqual([1, 2])
  leave()
  expect(second.ops('unsubscribe')).toHaveLength(1)
  second.say({ op: 'publish', topic: '/odom', msg: 3 })
  expect(got).toEqual([1, 2])
})

it('takes nothing from a connection it has left', async () => {
  const got: unknown[] = []
  link.subscribe('/odom', 'nav_msgs/msg/Odometry', (message) => got.push(message))
  const first = await opened()
  link.abandon()
  expect(states.at(-1)![0]).toBe('waiting')
  await vi.advanceTimersByTimeAsync(20_000)
  await opened()
  first.end(1006)
  expect(link.state).toBe('open')
})

it('answers calls, and fails them in the relay’s words', async () => {
  const socket = await opened()
  const good = link.call('/relay/ping', 't', { robot: false })
  const bad = link.call('/reset', 't', {})
  const [first, second] = socket.ops('call_service')
  socket.say({ op: 'service_response', id: first!.id, service: '/relay/ping', result: true, values: { n: 1 } })
  socket.say({ op: 'service_response', id: second!.id, service: '/reset', result: false, values: 'not for viewers' })
  await expect(good).resolves.toEqual({ n: 1 })
  await expect(bad).rejects.toThrow('not for viewers')
})

it('fails calls that are out when the connection closes, and calls without one', async () => {
  const socket = await opened()
  const call = link.call('/relay/ping', 't', {})
  socket.end(1006)
  await expect(call).rejects.toThrow('lost')
  await expect(link.call('/relay/ping', 't', {})).rejects.toThrow('no connection')
})

it('sends goals, passes feedback on, and gives their ends as they are', async () => {
  const socket = await opened()
  const feedback: unknown[] = []
  const type = 'nav2_msgs/action/NavigateToPose'
  const goals = [1, 2].map((x) => link.sendGoal('/navigate_to_pose', type, { x }, (values) => feedback.push(values)))
  const [first, second] = socket.ops('send_action_goal')
  expect(first).toMatchObject({ action: '/navigate_to_pose', action_type: type, args: { x: 1 }, feedback: true })
  socket.say({ op: 'action_feedback', action: '/navigate_to_pose', id: first!.id, values: { left: 3 } })
  socket.say({ op: 'action_result', action: '/navigate_to_pose', id: first!.id, status: 6, result: true, values: { error_code: 208 } })
  await expect(goals[0]!.result).resolves.toEqual({ status: 6, values: { error_code: 208 } })
  expect(feedback).toEqual([{ left: 3 }])
  goals[1]!.cancel()
  expect(socket.ops('cancel_action_goal')).toMatchObject([{ action: '/navigate_to_pose', id: second!.id }])
  socket.end(1006)
  await expect(goals[1]!.result).rejects.toThrow('lost')
  goals[1]!.cancel()
  expect(() => link.sendGoal('/navigate_to_pose', type, {}, () => {})).toThrow('no connection')
})

it('fails a call that is never answered', async () => {
  await opened()
  const call = expect(link.call('/slow', 't', {}, 2)).rejects.toThrow('did not answer')
  await vi.advanceTimersByTimeAsync(3000)
  await call
})

it.each([4401, 4403, 4404])('does not dial again after the close code %i', async (code) => {
  const socket = await opened()
  socket.end(code, 'because')
  await vi.advanceTimersByTimeAsync(120_000)
  expect(FakeSocket.all).toHaveLength(1)
  expect(states.at(-1)![0]).toBe('ended')
})

it.each([1001, 1006, 4408])('dials again after the close code %i', async (code) => {
  const socket = await opened()
  socket.end(code)
  expect(states.at(-1)![0]).toBe('waiting')
  await vi.advanceTimersByTimeAsync(20_000)
  expect(FakeSocket.all.length).toBeGreaterThan(1)
})

it('waits longer while dialling fails', async () => {
  for (let i = 0; i < 4; i++) {
    await vi.advanceTimersByTimeAsync(0)
    latest().end(1006)
    await vi.advanceTimersByTimeAsync(20_000)
  }
  const before = FakeSocket.all.length
  latest().end(1006)
  await vi.advanceTimersByTimeAsync(3000)
  expect(FakeSocket.all).toHaveLength(before)
  link.retryNow()
  expect(FakeSocket.all).toHaveLength(before + 1)
})

it('knows a stalled socket by what it has not sent', async () => {
  const socket = await opened()
  expect(link.isStalled).toBe(false)
  socket.bufferedAmount = 100_000
  expect(link.isStalled).toBe(true)
})

it('is silent once closed by the page', async () => {
  const socket = await opened()
  link.close()
  const count = states.length
  socket.end(1000)
  await vi.advanceTimersByTimeAsync(120_000)
  expect(states).toHaveLength(count)
  expect(FakeSocket.all).toHaveLength(1)
})
