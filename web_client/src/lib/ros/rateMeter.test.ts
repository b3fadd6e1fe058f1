import { expect, it } from 'vitest'
import { Gate, isStale, RateMeter } from './rateMeter'

it('measures a steady rate', () => {
  const meter = new RateMeter(2000)
  for (let t = 0; t <= 5000; t += 100) meter.mark(t)
  expect(meter.perSecond(5000)).toBeCloseTo(10, 0)
})

it('measures a rate before its window is full', () => {
  const meter = new RateMeter(2000)
  for (let t = 0; t <= 500; t += 50) meter.mark(t)
  expect(meter.perSecond(500)).toBeCloseTo(20)
})

it('adds up what each event brings', () => {
  const meter = new RateMeter(2000)
  for (let t = 0; t <= 5000; t += 100) meter.mark(t, 500)
  expect(meter.perSecond(5000)).toBeCloseTo(5000, -2)
})

it('falls to zero when nothing more comes', () => {
  const meter = new RateMeter(2000)
  for (let t = 0; t <= 5000; t += 100) meter.mark(t)
  expect(meter.perSecond(6000)).toBeLessThan(7)
  expect(meter.perSecond(7001)).toBe(0)
})

it('knows no rate of nothing', () => {
  const meter = new RateMeter()
  expect(meter.perSecond(1000)).toBe(0)
  meter.mark(1000)
  expect(meter.perSecond(1000)).toBe(0)
  meter.mark(1100)
  meter.reset()
  expect(meter.perSecond(1200)).toBe(0)
})

it('calls a value stale after a second, and one that never came too', () => {
  expect(isStale(1000, 2000)).toBe(false)
  expect(isStale(1000, 2001)).toBe(true)
  expect(isStale(null, 0)).toBe(true)
})

it('lets one call through per interval', () => {
  const gate = new Gate(100)
  expect([0, 50, 99, 100, 150, 300].map((t) => gate.open(t))).toEqual([true, false, false, true, false, true])
})
