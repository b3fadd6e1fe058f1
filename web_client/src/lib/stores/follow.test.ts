import { afterEach, beforeEach, expect, test, vi } from 'vitest'
import { keepFollowing, repeat } from './follow'

beforeEach(() => void vi.useFakeTimers())
afterEach(() => {
  vi.useRealTimers()
  vi.unstubAllGlobals()
})

class Page extends EventTarget {
  visibilityState = 'visible'

  shows(state: string) {
    this.visibilityState = state
    this.dispatchEvent(new Event('visibilitychange'))
  }
}

/** Work that lasts until its signal ends. */
function streams() {
  const open = new Set<AbortSignal>()
  const stream = (signal: AbortSignal) =>
    new Promise<void>((_, reject) => {
      open.add(signal)
      signal.addEventListener('abort', () => {
        open.delete(signal)
        reject(new Error('aborted'))
      })
    })
  return { open, stream }
}

test('a hidden page follows nothing, and a page that is seen again follows at once', async () => {
  const page = new Page()
  vi.stubGlobal('document', page)
  const { open, stream } = streams()
  const failed = vi.fn()
  const end = keepFollowing(stream, failed)
  expect(open.size).toBe(1)
  page.shows('hidden')
  await vi.advanceTimersByTimeAsync(60_000)
  expect(open.size).toBe(0)
  page.shows('visible')
  expect(open.size).toBe(1)
  page.shows('visible')
  expect(open.size).toBe(1)
  end()
  page.shows('visible')
  await vi.advanceTimersByTimeAsync(60_000)
  expect(open.size).toBe(0)
  expect(failed).not.toHaveBeenCalled()
})

test('a page that is opened in the background begins when it is seen', () => {
  const page = new Page()
  page.visibilityState = 'hidden'
  vi.stubGlobal('document', page)
  const { open, stream } = streams()
  const end = keepFollowing(stream, () => {})
  expect(open.size).toBe(0)
  page.shows('visible')
  expect(open.size).toBe(1)
  end()
})

test('work that fails begins again, but not while the page is hidden', async () => {
  const page = new Page()
  vi.stubGlobal('document', page)
  const stream = vi.fn(() => Promise.reject(new Error('lost')))
  const failed = vi.fn()
  const end = keepFollowing(stream, failed)
  await vi.advanceTimersByTimeAsync(2000)
  expect(stream).toHaveBeenCalledTimes(2)
  expect(failed).toHaveBeenCalledWith('lost')
  page.shows('hidden')
  await vi.advanceTimersByTimeAsync(60_000)
  expect(stream).toHaveBeenCalledTimes(2)
  end()
})

test('work runs at once, and again after each pause, until it is ended', async () => {
  const work = vi.fn(async () => {})
  const end = repeat(work, 1000)
  expect(work).toHaveBeenCalledTimes(1)
  await vi.advanceTimersByTimeAsync(2500)
  expect(work).toHaveBeenCalledTimes(3)
  end()
  await vi.advanceTimersByTimeAsync(5000)
  expect(work).toHaveBeenCalledTimes(3)
})

test('a run that ends after the page has gone is the last one', async () => {
  let finish = () => {}
  const work = vi.fn(() => new Promise<void>((resolve) => (finish = resolve)))
  const end = repeat(work, 1000)
  end()
  finish()
  await vi.advanceTimersByTimeAsync(5000)
  expect(work).toHaveBeenCalledTimes(1)
})
