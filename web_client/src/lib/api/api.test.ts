import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest'
import { currentSession, giveOrder, moment, STOP_TIMEOUT_MS, stopRobot } from './api'
import { Refusal, Unreachable } from './request'

interface Asked {
  path: string
  init: RequestInit
  answer: (response: Response) => void
}

let asked: Asked[]

beforeEach(() => {
  vi.useFakeTimers()
  asked = []
  // As a browser does it: what is given up fails, the body too.
  vi.stubGlobal('fetch', (path: string, init: RequestInit) => {
    return new Promise<Response>((answer, reject) => {
      init.signal?.addEventListener('abort', () => reject(new DOMException('', 'AbortError')))
      asked.push({ path, init, answer })
    })
  })
})

afterEach(() => {
  vi.useRealTimers()
  vi.unstubAllGlobals()
})

/** How a promise stands: its value or its error, or nothing yet. */
function outcome<T>(work: Promise<T>): unknown[] {
  const found: unknown[] = []
  work.then(
    (value) => found.push(value),
    (error: unknown) => found.push(error),
  )
  return found
}

/** The lines of an answer, given one after the other. */
function lines(signal: AbortSignal | null | undefined) {
  let out!: ReadableStreamDefaultController<Uint8Array>
  const body = new ReadableStream<Uint8Array>({ start: (controller) => void (out = controller) })
  signal?.addEventListener('abort', () => out.error(new DOMException('', 'AbortError')))
  const say = (line: object) => out.enqueue(new TextEncoder().encode(`${JSON.stringify(line)}\n`))
  return { response: new Response(body), say, end: () => out.close(), fail: () => out.error(new TypeError('network error')) }
}

/** The bodies of all requests so far. */
const bodies = () => asked.map(({ init }) => JSON.parse(String(init.body)) as { stop_id?: string })

describe('the id of a stop', () => {
  it('is a new one for each press, and the one that is given for a press by several paths', () => {
    for (const id of [undefined, undefined, 'press-1']) void stopRobot('rover', '', id)
    for (const count of [1, 2]) void giveOrder({ robots: [`r${count}`], do: 'stop' }, () => {})
    void giveOrder({ robots: ['r'], do: 'publish', topic: '/mode' }, () => {})
    const ids = bodies().map(({ stop_id }) => stop_id)
    expect(ids[2]).toBe('press-1')
    expect(ids[5]).toBeUndefined()
    const made = [0, 1, 3, 4].map((i) => ids[i])
    for (const id of made) expect(id).toMatch(/^[0-9a-f]{32}$/)
    expect(new Set(made).size).toBe(4)
  })
})

describe('a stop of one robot', () => {
  it('that is never answered is given up, later than the relay ever answers', async () => {
    const found = outcome(stopRobot('rover'))
    await vi.advanceTimersByTimeAsync(21_500)
    expect(found).toEqual([])
    await vi.advanceTimersByTimeAsync(STOP_TIMEOUT_MS - 21_500)
    expect(found).toEqual([expect.any(Unreachable)])
  })

  it('goes out though the page is left, and waits for nothing once it is answered', async () => {
    const found = outcome(stopRobot('rover'))
    expect(asked[0]?.init).toMatchObject({ method: 'POST', keepalive: true })
    asked[0]?.answer(new Response('{}', { status: 202 }))
    await vi.advanceTimersByTimeAsync(0)
    expect(found).toEqual([true])
    expect(vi.getTimerCount()).toBe(0)
  })

  it('tells what the robot said from what nobody knows', async () => {
    const found = [409, 503].map((status) => outcome(stopRobot(String(status))))
    asked.forEach(({ path, answer }) => answer(new Response('{}', { status: Number(path.split('/').at(-2)) })))
    await vi.advanceTimersByTimeAsync(0)
    expect(found.flat().map((error) => (error as Refusal).byRobot)).toEqual([true, false])
  })
})

describe('an order to many', () => {
  const STOP = { robots: ['*'], do: 'stop' } as const

  it('to stop is given up when nothing more comes of its answer, however long that has gone on', async () => {
    const received: object[] = []
    const found = outcome(giveOrder({ ...STOP, robots: ['*'] }, (line) => received.push(line)))
    const answer = lines(asked[0]?.init.signal)
    asked[0]?.answer(answer.response)
    for (const robot of ['a', 'b', 'c']) {
      await vi.advanceTimersByTimeAsync(STOP_TIMEOUT_MS - 1)
      answer.say({ robot })
    }
    await vi.advanceTimersByTimeAsync(STOP_TIMEOUT_MS - 1)
    expect([found, received.length]).toEqual([[], 3])
    await vi.advanceTimersByTimeAsync(1)
    expect(found).toEqual([expect.any(Unreachable)])
  })

  it('of another kind is waited for as long as it takes, unless it is ended', async () => {
    const ending = new AbortController()
    const found = outcome(giveOrder({ robots: ['*'], do: 'publish', topic: '/mode' }, () => {}, ending.signal))
    await vi.advanceTimersByTimeAsync(300_000)
    expect(found).toEqual([])
    ending.abort()
    await vi.advanceTimersByTimeAsync(0)
    expect(found).toEqual([expect.any(Unreachable)])
  })

  it('whose answer breaks off is told in words', async () => {
    const found = outcome(giveOrder({ ...STOP, robots: ['*'] }, () => {}))
    const answer = lines(asked[0]?.init.signal)
    asked[0]?.answer(answer.response)
    await vi.advanceTimersByTimeAsync(0)
    answer.fail()
    await vi.advanceTimersByTimeAsync(0)
    expect(found).toEqual([expect.any(Unreachable)])
    expect(vi.getTimerCount()).toBe(0)
  })

  it('to stop goes out though the page is left, as far as browsers allow', () => {
    const robots = (count: number) => Array.from({ length: count }, (_, i) => `rover-${i}-of-a-large-house-with-many-halls`)
    for (const count of [1, 1000]) void giveOrder({ robots: robots(count), do: 'stop' }, () => {})
    void giveOrder({ robots: ['*'], do: 'publish', topic: '/mode' }, () => {})
    expect(asked.map(({ init }) => init.keepalive)).toEqual([true, false, false])
  })
})

describe('what moves a robot, or lets it move again', () => {
  const ways = (['resume', 'call', 'set'] as const).map((what): [string, () => Promise<void>, string, string] => [
    what,
    () => giveOrder({ robots: ['*'], do: what }, () => {}),
    '/api/v1/fleet/groups',
    '/api/v1/fleet',
  ])

  it.each(ways)('gives back the moment of an answer that was asked for just before: %s', async (_, act, asks, does) => {
    void outcome(act())
    await vi.advanceTimersByTimeAsync(0)
    expect(asked.map(({ path, init }) => [init.method, path])).toEqual([['GET', asks]])
    asked[0]?.answer(new Response('{}', { headers: { 'switchboard-freshness': 'ff.1' } }))
    await vi.advanceTimersByTimeAsync(0)
    expect(asked[1]?.path).toBe(does)
    expect(new Headers(asked[1]?.init.headers).get('switchboard-freshness')).toBe('ff.1')
    expect(new Headers(asked[1]?.init.headers).get('content-type')).toBe('application/json')
  })

  it('gives back the moment at which a press for it began', async () => {
    const pressed = moment()
    asked[0]?.answer(new Response('{}', { headers: { 'switchboard-freshness': 'ff.1' } }))
    await vi.advanceTimersByTimeAsync(1_500)
    void outcome(giveOrder({ robots: ['*'], do: 'resume' }, () => {}, undefined, pressed))
    await vi.advanceTimersByTimeAsync(0)
    expect(asked.map(({ init }) => init.method)).toEqual(['GET', 'POST'])
    expect(new Headers(asked[1]?.init.headers).get('switchboard-freshness')).toBe('ff.1')
  })

  it.each(ways)('is not asked for when that took long: %s', async (_, act) => {
    const found = outcome(act())
    await vi.advanceTimersByTimeAsync(2_000)
    expect(found).toEqual([expect.any(Unreachable)])
    // A page that was frozen has its timers late.
    const again = outcome(act())
    vi.setSystemTime(Date.now() + 60_000)
    vi.spyOn(performance, 'now').mockReturnValue(performance.now() + 60_000)
    asked[1]?.answer(new Response('{}', { headers: { 'switchboard-freshness': 'ff.1' } }))
    await vi.advanceTimersByTimeAsync(0)
    expect(again).toEqual([expect.any(Unreachable)])
    expect(asked).toHaveLength(2)
    vi.restoreAllMocks()
  })
})

it('who is logged in is not waited for for ever', async () => {
  const found = outcome(currentSession())
  await vi.advanceTimersByTimeAsync(10_000)
  expect(found).toEqual([expect.any(Unreachable)])
})
