import { describe, expect, it } from 'vitest'
import { AT_ONCE, fetchAllPages, isWorse, leftOpen, line, merged, News, REMEMBERED, STREAMED, summary, waiting, worst } from './alerts'
import type { Alert } from './types'

function alert(id: string, more: Partial<Alert> = {}): Alert {
  return {
    id,
    robot: 'rover',
    kind: 'offline',
    about: '',
    level: 'error',
    text: 'it is offline',
    first: 100,
    last: 100,
    count: 1,
    state: 'open',
    over: null,
    acknowledged: null,
    may_acknowledge: true,
    notification_count: 1,
    notify: true,
    ...more,
  }
}

it('tells nothing of what stood when the page was opened', () => {
  expect(new News().take([alert('a'), alert('b')])).toEqual([])
})

it('tells each piece of news once, the oldest first', () => {
  const news = new News()
  news.take([alert('a')])
  const two = [alert('c'), alert('b'), alert('a')]
  expect(news.take(two).map(({ id }) => id)).toEqual(['b', 'c'])
  expect(news.take(two)).toEqual([])
  expect(news.take([alert('a', { notification_count: 2, state: 'over' })]).map(({ id }) => id)).toEqual(['a'])
})

it('tells nothing the user’s rules do not want', () => {
  const news = new News()
  news.take([])
  expect(news.take([alert('a', { notify: false })])).toEqual([])
})

it('tells at the end of quiet hours what began in them and still stands', () => {
  const news = new News()
  const ids = (...alerts: Alert[]) => news.take(alerts).map(({ id }) => id)
  const over = { state: 'over', notification_count: 2 } as const
  ids(alert('d'))
  expect(ids(alert('a'), alert('b'), alert('d'))).toEqual(['b', 'a'])
  const quiet = { notify: false }
  expect(ids(alert('c', quiet), alert('a', { ...quiet, ...over }), alert('e', quiet), alert('d', quiet))).toEqual([])
  expect(ids(alert('c', quiet), alert('a', { ...quiet, ...over }), alert('e', { ...quiet, ...over }))).toEqual([])
  expect(ids(alert('c'), alert('a', over), alert('e', over))).toEqual(['a', 'c'])
  expect(ids(alert('c'), alert('a', over), alert('e', over))).toEqual([])
})

describe('a list that is full', () => {
  /** `count` open alerts that began one after the other from a time on, the latest first. */
  function open(from: number, count: number): Alert[] {
    return Array.from({ length: count }, (_, i) => alert(`${from + i}`, { first: from + i, last: from + i })).reverse()
  }
  const ids = (alerts: Alert[]) => alerts.map(({ id }) => id)

  it('tells nothing of those that come into it because others are over', () => {
    const news = new News()
    news.take(open(20, STREAMED))
    expect(ids(news.take(open(10, STREAMED)))).toEqual([])
    expect(ids(news.take(open(0, 50)))).toEqual([])
  })

  it('tells of those that begin', () => {
    const news = new News()
    news.take(open(20, STREAMED))
    expect(ids(news.take(open(23, STREAMED)))).toEqual(['120', '121', '122'])
    expect(ids(news.take(open(23, STREAMED)))).toEqual([])
  })

  it('tells nothing of one that it left out for a while, but that it is over or worse', () => {
    const news = new News()
    news.take(open(0, 3))
    news.take(open(1000, STREAMED))
    const [two, one, zero] = open(0, 3) as [Alert, Alert, Alert]
    const back = [two, { ...one, notification_count: 2, state: 'over' as const, over: 2000 }, { ...zero, notification_count: 2 }]
    expect(ids(news.take([...open(1000, 97), ...back]))).toEqual(['0', '1'])
  })

  it('that was so before leaves out none', () => {
    const news = new News()
    news.take(open(20, STREAMED))
    news.take(open(20, 99))
    expect(ids(news.take([...open(20, 99), alert('late', { first: 3 })]))).toEqual(['late'])
  })
})

it('remembers alerts that are told no more, within bounds', () => {
  const news = new News()
  const many = Array.from({ length: REMEMBERED }, (_, i) => alert(`${i}`))
  news.take([])
  news.take([alert('a')])
  for (let i = 0; i + 50 < REMEMBERED; i += 50) news.take(many.slice(i, i + 50))
  expect(news.take([alert('a')])).toEqual([])
  for (let i = 0; i < REMEMBERED; i += 50) news.take(many.slice(i, i + 50))
  expect(news.take([alert('a')])).toHaveLength(1)
})

it('counts those that stand and nobody looks after', () => {
  const acknowledged = { by: 'ann', at: 1 }
  expect(waiting([alert('a'), alert('b', { state: 'over' }), alert('c', { acknowledged })])).toBe(1)
})

it('says one alert in its own words, and of many the worst that stands and how many', () => {
  expect(line(alert('a'))).toBe('rover: it is offline')
  expect(line(alert('a', { state: 'over' }))).toBe('rover: over: it is offline')
  const over = alert('o', { state: 'over', text: 'it was away' })
  const low = alert('l', { level: 'warning', text: 'low' })
  expect(summary([low])).toBe('rover: low')
  expect(summary([low, alert('a'), alert('b', { text: 'it is hot' }), over])).toBe('rover: it is hot, and 3 more')
  expect(summary([low, over])).toBe('rover: low, and 1 more')
  expect(summary([over, over])).toBe('rover: over: it was away, and 1 more')
})

it('finds the worst', () => {
  expect(worst([])).toBeNull()
  expect(worst([alert('a', { level: 'info' }), alert('b', { level: 'warning' })])).toBe('warning')
  expect([isWorse('error', 'warning'), isWorse('info', null), isWorse('info', 'info'), isWorse(null, 'info')]).toEqual([
    true,
    true,
    false,
    false,
  ])
})

it('puts what is told meanwhile into the list, the latest first and only what fits', () => {
  const list = [alert('a', { last: 10 }), alert('b', { last: 5 })]
  const live = [alert('b', { last: 20 }), alert('c', { last: 15, robot: 'other' })]
  const ids = (filter: Parameters<typeof merged>[2]) => merged(list, live, filter).map(({ id }) => id)
  expect(ids({ robot: '', state: 'all' })).toEqual(['b', 'c', 'a'])
  expect(ids({ robot: 'rover', state: 'open' })).toEqual(['b', 'a'])
  expect(ids({ robot: '', state: 'over' })).toEqual([])
})

describe('a long list', () => {
  /** A relay with so many alerts; what it was asked. */
  function relay(count: number) {
    const all = Array.from({ length: count }, (_, i) => alert(`${i}`))
    const asked: [number, string | null][] = []
    async function ask(limit: number, before: string | null) {
      asked.push([limit, before])
      const from = Number(before ?? 0)
      const alerts = all.slice(from, from + limit)
      return Promise.resolve({ alerts, next: from + limit < count ? String(from + limit) : null })
    }
    return { all, asked, ask }
  }

  it('is asked for in parts until it is as long as is wanted', async () => {
    const { all, asked, ask } = relay(2000)
    expect(await fetchAllPages(ask, 1200)).toEqual({ alerts: all.slice(0, 1200), next: '1200' })
    expect(asked).toEqual([
      [AT_ONCE, null],
      [AT_ONCE, '500'],
      [200, '1000'],
    ])
  })

  it('ends where there is no more', async () => {
    const { all, asked, ask } = relay(600)
    expect(await fetchAllPages(ask, 1200)).toEqual({ alerts: all, next: null })
    expect(asked).toHaveLength(2)
  })
})

it('notices an alert that is told no more though it was not over', () => {
  const [a, b] = [alert('a'), alert('b', { state: 'over' })]
  expect(leftOpen([a, b], [a])).toBe(false)
  expect(leftOpen([a, b], [b])).toBe(true)
  expect(leftOpen([a], Array.from({ length: STREAMED }, (_, i) => alert(`${i}`)))).toBe(false)
})
