import { expect, it, vi } from 'vitest'
import { giveOrder, robotSocket } from './api/api'
import { pause } from './api/backoff'
import { ending } from './api/closeCodes'
import { counts, select } from './api/robotList'
import type { Robot } from './api/types'
import { refusal } from './api/request'

it('waits longer after each attempt, within bounds', () => {
  expect(pause(0, 0.5)).toBe(500)
  expect(pause(3, 0.5)).toBe(4000)
  for (const attempt of [5, 50, 5000]) expect(pause(attempt, 1)).toBeLessThanOrEqual(18_750)
  expect(pause(2, 0)).toBeLessThan(pause(2, 1))
})

it('tells what a close code means and whether to try again', () => {
  expect(ending(4401, '').after).toBe('login')
  expect(ending(4403, 'revoked by admin')).toEqual({
    after: 'give_up',
    words: 'You no longer have a right to this robot. Revoked by admin.',
  })
  expect(ending(4404, '').after).toBe('give_up')
  for (const code of [1001, 1006, 1011, 4408, 4999]) expect(ending(code, '').after).toBe('retry')
})

it('builds the address of a robot’s websocket', () => {
  expect(robotSocket('r 1', { protocol: 'https:', host: 'relay:9090' })).toBe('wss://relay:9090/robots/r%201')
  expect(robotSocket('r1', { protocol: 'http:', host: 'h' })).toBe('ws://h/robots/r1')
})

it('hands on the relay’s own words of refusal', async () => {
  const problem = { type: 'about:blank', title: 'Too many', status: 429, detail: 'Wait a little.' }
  const refused = await refusal(new Response(JSON.stringify(problem), { status: 429, headers: { 'Retry-After': '7' } }))
  expect(refused).toMatchObject({ status: 429, message: 'Wait a little.', retryAfter: 7 })
  const dumb = await refusal(new Response('<html>', { status: 502 }))
  expect(dumb).toMatchObject({ status: 502, message: 'The relay answered with error 502.', retryAfter: null })
})

it.each([
  ['stop', true],
  ['set', false],
] as const)('an order to %s outlives the page that gave it: %s', async (kind, outlives) => {
  const asked = vi.fn(async (_: string, init: RequestInit) => new Response(`{"do":"${init.method}"}\n{"done":true}\n`))
  vi.stubGlobal('fetch', asked)
  const lines: object[] = []
  await giveOrder({ robots: ['*'], do: kind }, (line) => lines.push(line))
  vi.unstubAllGlobals()
  // What moves robots asks for a moment first.
  expect(asked.mock.calls.at(-1)?.[1].keepalive).toBe(outlives)
  expect(lines).toEqual([{ do: 'POST' }, { done: true }])
})

const robot = (name: string, state: Robot['state'], description = ''): Robot => ({
  name,
  description,
  state,
  level: 'viewer',
  clients: state === 'in_use' ? [{ user: 'ann', since: 0, camera: '' }] : [],
  people: 0,
  holder: null,
  stopped: null,
  suppressed: [],
  inhibited: [],
  battery: null,
  rtt_ms: null,
  quality: '',
  host: '',
  platform: 'ros2',
  distro: 'jazzy',
  last_seen: null,
})

it('lists reachable robots first, then by name as people count', () => {
  const fleet = [robot('r10', 'online'), robot('r1', 'offline'), robot('r2', 'in_use')]
  expect(select(fleet, '', 'all').map((r) => r.name)).toEqual(['r2', 'r10', 'r1'])
  expect(counts(fleet)).toEqual({ all: 3, online: 1, in_use: 1, offline: 1 })
})

it('searches names, descriptions and users', () => {
  const fleet = [robot('r1', 'online', 'Lawn mower'), robot('r2', 'in_use')]
  expect(select(fleet, 'MOWER jazzy', 'all').map((r) => r.name)).toEqual(['r1'])
  expect(select(fleet, 'ann', 'all').map((r) => r.name)).toEqual(['r2'])
  expect(select(fleet, '', 'offline')).toEqual([])
})
