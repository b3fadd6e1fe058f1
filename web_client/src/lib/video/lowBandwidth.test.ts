import { expect, it } from 'vitest'
import { possibleFps, LowBandwidthDetector } from './lowBandwidth'

/** When the link is called too thin, in seconds, of pictures that come at these times; null: never. */
function judged(pictures: { at: number; key: boolean }[], perSecond = 15, link = new LowBandwidthDetector()): number | null {
  for (const { at, key } of pictures) if (link.mark({ key }, at * 1000, perSecond)) return at
  return null
}

function every(seconds: number, count: number, key: (n: number) => boolean = () => true) {
  return Array.from({ length: count }, (_, n) => ({ at: n * seconds, key: key(n) }))
}

it('calls a link too thin that brings nothing but rare key frames for ten seconds', () => {
  expect(judged(every(1.25, 40))).toBe(10)
  expect(judged(every(8, 5))).toBe(16)
})

it('takes a stray picture between them for none', () => {
  expect(judged(every(1.25, 40, (n) => n !== 4))).toBe(10)
})

it('says nothing of a link that keeps up, or of key frames that follow each other soon', () => {
  expect(judged(every(1 / 15, 600, (n) => n % 30 === 0))).toBe(null)
  expect(judged(every(0.5, 60))).toBe(null)
})

it('says nothing of a link that brings what is between the key frames', () => {
  expect(judged(every(1.25, 40, (n) => n % 3 === 0))).toBe(null)
})

it('says nothing of a camera that gives no more, or of which nobody knows what it gives', () => {
  expect(judged(every(2, 20), 0.5)).toBe(null)
  expect(judged(every(2, 20), 0)).toBe(null)
})

it('begins again with another connection', () => {
  const link = new LowBandwidthDetector()
  expect(judged(every(1.25, 8), 15, link)).toBe(null)
  link.reset()
  const later = every(1.25, 8).map(({ at, key }) => ({ at: at + 10, key }))
  expect(judged(later, 15, link)).toBe(null)
})

it('knows how many pictures could come', () => {
  expect(possibleFps(null)).toBe(0)
  expect(possibleFps({ fps: 5, source_fps: 0 })).toBe(0)
  expect(possibleFps({ fps: 0, source_fps: 15 })).toBe(15)
  expect(possibleFps({ fps: 5, source_fps: 15 })).toBe(5)
})
