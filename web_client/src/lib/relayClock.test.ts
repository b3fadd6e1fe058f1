import { readdirSync, readFileSync } from 'node:fs'
import { join } from 'node:path'
import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest'

const NOW = Date.UTC(2026, 0, 2, 3, 4, 5)
const HOUR = 3600_000
let clock: typeof import('./relayClock')

beforeEach(async () => {
  vi.useFakeTimers({ now: NOW })
  vi.resetModules()
  clock = await import('./relayClock')
})
afterEach(() => {
  vi.useRealTimers()
})

/** An answer of a relay whose clock is ahead, after a request that took some time. */
function answer(ahead: number, took = 40): void {
  clock.learnRelayTime(new Date(Date.now() + ahead).toUTCString(), Date.now() - took)
}

describe('the time of the relay', () => {
  it('is the device’s time as long as nothing says that this is wrong', () => {
    expect(clock.relayTime()).toBe(NOW / 1000)
    answer(0)
    expect(clock.relayTime()).toBe(NOW / 1000)
    for (const date of [null, '', 'soon']) clock.learnRelayTime(date, NOW)
    expect(clock.relayTime()).toBe(NOW / 1000)
  })

  it.each([HOUR, -HOUR, 90_000])('is known to a second after one answer (%d ms ahead)', (ahead) => {
    answer(ahead)
    expect(Math.abs(clock.relayTime() * 1000 - NOW - ahead)).toBeLessThan(1100)
  })

  it('becomes more exact with further answers, and slow ones do not make it worse', () => {
    for (let part = 0; part < 10; part++) {
      answer(HOUR + 300)
      vi.advanceTimersByTime(110)
    }
    const known = clock.relayTime() * 1000 - Date.now()
    expect(Math.abs(known - HOUR - 300)).toBeLessThan(200)
    answer(HOUR + 300, 20_000)
    expect(clock.relayTime() * 1000 - Date.now()).toBe(known)
  })

  it('is learned anew when the device’s clock was set', () => {
    answer(HOUR)
    vi.setSystemTime(NOW + HOUR)
    answer(0)
    expect(clock.relayTime()).toBe((NOW + HOUR) / 1000)
  })
})

it('is the time on every page', () => {
  const root = join(import.meta.dirname, '..')
  const files = readdirSync(root, { recursive: true, encoding: 'utf8' }).filter((each) => /\.(svelte|ts)$/.test(each))
  // The device's clock only measures how long something takes there, or dates a file of the device.
  const own = ['lib/relayClock.ts', 'pages/Login.svelte', 'lib/api/request.ts', 'lib/api/files.ts']
  const others = files.filter((each) => !/\.test\.ts$/.test(each) && !own.includes(each))
  expect(others.length).toBeGreaterThan(100)
  expect(others.filter((each) => /Date\.now\(\)|new Date\(\)/.test(readFileSync(join(root, each), 'utf8')))).toEqual([])
})
