import { expect, it } from 'vitest'
import { type Alert, leftOpen, line, lines, merged, News, STREAMED, waiting, worst } from './alerts'

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
    news: 1,
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
  expect(news.take([alert('a', { news: 2, state: 'over' })]).map(({ id }) => id)).toEqual(['a'])
})

it('tells nothing the user’s rules do not want', () => {
  const news = new News()
  news.take([])
  expect(news.take([alert('a', { notify: false })])).toEqual([])
})

it('tells at the end of quiet hours what began in them and still stands', () => {
  const news = new News()
  const ids = (...alerts: Alert[]) => news.take(alerts).map(({ id }) => id)
  const over = { state: 'over', news: 2 } as const
  ids(alert('d'))
  expect(ids(alert('a'), alert('b'), alert('d'))).toEqual(['b', 'a'])
  const quiet = { notify: false }
  expect(ids(alert('c', quiet), alert('a', { ...quiet, ...over }), alert('e', quiet), alert('d', quiet))).toEqual([])
  expect(ids(alert('c', quiet), alert('a', { ...quiet, ...over }), alert('e', { ...quiet, ...over }))).toEqual([])
  expect(ids(alert('c'), alert('a', over), alert('e', over))).toEqual(['a', 'c'])
  expect(ids(alert('c'), alert('a', over), alert('e', over))).toEqual([])
})

it('remembers no more than what it was shown last', () => {
  const news = new News()
  news.take([alert('a')])
  news.take([])
  expect(news.take([alert('a', { news: 2 })])).toHaveLength(1)
})

it('counts those that stand and nobody looks after', () => {
  const acknowledged = { by: 'ann', at: 1 }
  expect(waiting([alert('a'), alert('b', { state: 'over' }), alert('c', { acknowledged })])).toBe(1)
})

it('says few alerts in their own words, and of many how many', () => {
  expect(line(alert('a'))).toBe('rover: it is offline')
  expect(line(alert('a', { state: 'over' }))).toBe('rover: over: it is offline')
  expect(lines([alert('a'), alert('b')])).toHaveLength(2)
  expect(lines([alert('a'), alert('b'), alert('c')])).toEqual(['3 new alerts of rover.'])
  expect(lines([alert('a'), alert('b'), alert('c', { robot: 'other' })])).toEqual(['3 new alerts of 2 robots.'])
})

it('finds the worst', () => {
  expect(worst([])).toBeNull()
  expect(worst([alert('a', { level: 'info' }), alert('b', { level: 'warning' })])).toBe('warning')
})

it('puts what is told meanwhile into the list, the latest first and only what fits', () => {
  const list = [alert('a', { last: 10 }), alert('b', { last: 5 })]
  const live = [alert('b', { last: 20 }), alert('c', { last: 15, robot: 'other' })]
  const ids = (filter: Parameters<typeof merged>[2]) => merged(list, live, filter).map(({ id }) => id)
  expect(ids({ robot: '', state: 'all' })).toEqual(['b', 'c', 'a'])
  expect(ids({ robot: 'rover', state: 'open' })).toEqual(['b', 'a'])
  expect(ids({ robot: '', state: 'over' })).toEqual([])
})

it('notices an alert that is told no more though it was not over', () => {
  const [a, b] = [alert('a'), alert('b', { state: 'over' })]
  expect(leftOpen([a, b], [a])).toBe(false)
  expect(leftOpen([a, b], [b])).toBe(true)
  expect(leftOpen([a], Array.from({ length: STREAMED }, (_, i) => alert(`${i}`)))).toBe(false)
})
