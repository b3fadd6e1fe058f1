import { expect, it } from 'vitest'
import { added, settled, type Toast, type Told } from './toasts'

const told = (words: string, until: readonly string[] | null = null): Told => ({ kind: 'info', words, more: null, until })

function all(...said: Told[]): Toast[] {
  return said.reduce<Toast[]>((toasts, each, i) => added(toasts, each, i + 1).toasts, [])
}

const words = (toasts: Toast[]) => toasts.map((each) => each.words)

it('shows the latest few', () => {
  expect(words(all(told('a'), told('b'), told('c'), told('d')))).toEqual(['b', 'c', 'd'])
})

it('says the same once, with how often, and as it was said last', () => {
  const toasts = all(told('a'), told('b'), told('a', ['rover']))
  expect(toasts.map((each) => [each.words, each.times, each.id])).toEqual([
    ['a', 2, 1],
    ['b', 1, 2],
  ])
  expect(toasts[0]?.until).toEqual(['rover'])
})

it('what stays is not pushed off by what passes, nor is what comes', () => {
  expect(words(all(told('stays', []), told('b'), told('c'), told('d')))).toEqual(['stays', 'c', 'd'])
  expect(words(all(told('1', []), told('2', []), told('3', []), told('d')))).toEqual(['1', '2', '3', 'd'])
  expect(words(all(told('1', []), told('2', []), told('3', []), told('d'), told('e')))).toEqual(['1', '2', '3', 'e'])
  expect(words(all(told('1', []), told('2', []), told('3', []), told('d'), told('4', [])))).toEqual(['2', '3', '4'])
  expect(words(all(told('1', []), told('2', []), told('3', []), told('4', [])))).toEqual(['2', '3', '4'])
})

it('what was said of robots that were not known to stand is over when all of them do', () => {
  const toasts = all(told('both', ['a', 'b']), told('for ever', []), told('passing'))
  expect(settled(toasts, ['a', 'c'])).toBe(toasts)
  expect(words(settled(toasts, ['b', 'a']))).toEqual(['for ever', 'passing'])
})
