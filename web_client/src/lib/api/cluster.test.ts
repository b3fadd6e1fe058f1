import { expect, it } from 'vitest'
import { isBusy, isLate, lagWords, totals } from './cluster'
import type { RelayStatus } from './types'

function relay(more: Partial<RelayStatus>): RelayStatus {
  const load = { draining: false, robots: 3, clients: 4, forwarded: 2, cpu: 0.1, lag_s: 0.2 }
  return { id: 'a', address: 'one:9092', version: '1', protocol: 1, uptime_s: 1, own: true, state: 'ready', homes: 5, load, ...more }
}

it('adds up relays, also those that do not answer', () => {
  expect(totals([relay({}), relay({}), relay({ state: 'silent', load: null })])).toEqual({ robots: 11, clients: 8 })
})

it('finds relays that are busy or late', () => {
  const load = relay({}).load!
  expect([isBusy(relay({})), isLate(relay({}))]).toEqual([false, false])
  expect(isBusy(relay({ load: { ...load, cpu: 0.9 } }))).toBe(true)
  expect(isLate(relay({ load: { ...load, lag_s: 3 } }))).toBe(true)
  expect(isLate(relay({ load: null }))).toBe(false)
})

it.each([
  [0, '0 ms'],
  [0.25, '250 ms'],
  [1.23, '1.2 s'],
  [90, '1 min'],
  [1e6, 'over an hour'],
])('says the lag of %f s as %s', (seconds, words) => expect(lagWords(seconds)).toBe(words))
