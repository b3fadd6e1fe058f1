import { expect, it } from 'vitest'
import { grade, PingTracker, PONG_TIMEOUT_MS, RelayClock, ROBOT_LATE_MS, Silence } from './latency'

it('measures a round trip', () => {
  const pings = new PingTracker()
  const ping = pings.sent(1000)
  expect(pings.answered(ping, 1040)).toBe(40)
  expect(pings.rtt).toBe(40)
})

it('shows the usual round trip: one outlier does not move it, a lasting change does', () => {
  const pings = new PingTracker()
  const trips = (...all: number[]) => all.forEach((rtt, i) => pings.answered(pings.sent(i * 1000), i * 1000 + rtt))
  trips(900, 40, 41, 39, 40)
  expect(pings.rtt).toBe(40)
  trips(140, 141, 142)
  expect(pings.rtt).toBe(140)
})

it('is late once a ping has been out for longer than the timeout, and no more when it is answered', () => {
  const pings = new PingTracker()
  const ping = pings.sent(0)
  expect(pings.isLate(PONG_TIMEOUT_MS)).toBe(false)
  expect(pings.isLate(PONG_TIMEOUT_MS + 1)).toBe(true)
  pings.answered(ping, 800)
  expect(pings.isLate(801)).toBe(false)
})

it('is late by the oldest ping, even when newer ones left since', () => {
  const pings = new PingTracker()
  for (let t = 0; t <= 600; t += 200) pings.sent(t)
  expect(pings.isLate(601)).toBe(true)
  expect(pings.silentFor(601)).toBe(601)
})

it('forgets older pings when a newer one is answered', () => {
  const pings = new PingTracker()
  const first = pings.sent(0)
  pings.answered(pings.sent(100), 150)
  expect(pings.isLate(2000)).toBe(false)
  expect(pings.answered(first, 2000)).toBeNull()
})

it('is not late without pings, nor after a reset', () => {
  const pings = new PingTracker()
  expect(pings.isLate(1e6)).toBe(false)
  pings.sent(0)
  pings.reset()
  expect(pings.isLate(1e6)).toBe(false)
  expect(pings.rtt).toBeNull()
})

it('takes a ping that failed for nothing', () => {
  const pings = new PingTracker()
  pings.dropped(pings.sent(0))
  expect(pings.isLate(1e6)).toBe(false)
})

it('keeps a bounded number of unanswered pings', () => {
  const pings = new PingTracker()
  for (let t = 0; t < 100_000; t += 1000) pings.sent(t)
  expect(pings.silentFor(100_000)).toBeLessThanOrEqual(31_000)
})

it('grades round trips', () => {
  expect([20, 99, 100, 299, 300].map(grade)).toEqual(['good', 'good', 'fair', 'fair', 'bad'])
})

it('knows the relay’s time by the quickest of its latest answers', () => {
  const clock = new RelayClock()
  expect(clock.unixMs(0)).toBeNull()
  clock.update(1000, 1400, 51_390)
  clock.update(2000, 2020, 52_010)
  expect(clock.unixMs(3000)).toBe(53_000)
  for (let i = 0; i < 20; i++) clock.update(5000, 5030, 65_015)
  expect(clock.unixMs(6000)).toBe(66_000)
  clock.reset()
  expect(clock.unixMs(0)).toBeNull()
})

it('takes a robot for late until it answers, however many pings to it fail', () => {
  const silence = new Silence()
  expect(silence.isLate(1e6)).toBe(false)
  silence.sent(1000)
  expect(silence.isLate(1000 + ROBOT_LATE_MS)).toBe(false)
  expect(silence.isLate(1001 + ROBOT_LATE_MS)).toBe(true)
  silence.sent(11_000)
  expect(silence.isLate(11_000)).toBe(true)
  silence.over()
  silence.sent(12_000)
  expect(silence.isLate(12_100)).toBe(false)
})
