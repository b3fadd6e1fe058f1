import { expect, it } from 'vitest'
import { added, settled, type Toast, type NewToast } from './toasts'

const message = (words: string, until: readonly string[] | null = null): NewToast => ({ kind: 'info', words, more: null, until })

function all(...said: NewToast[]): Toast[] {
  return said.reduce<Toast[]>((toasts, each, i) => added(toasts, each, i + 1).toasts, [])
}

const words = (toasts: Toast[]) => toasts.map((each) => each.words)

it('shows the latest few', () => {
  expect(words(all(message('a'), message('b'), message('c'), message('d')))).toEqual(['b', 'c', 'd'])
})

it('says the same once, with how often, and as it was said last', () => {
  const toasts = all(message('a'), message('b'), message('a', ['rover']))
  expect(toasts.map((each) => [each.words, each.times, each.id])).toEqual([
    ['a', 2, 1],
    ['b', 1, 2],
  ])
  expect(toasts[0]?.until).toEqual(['rover'])
})

it('what stays is not pushed off by what passes, nor is what comes', () => {
  expect(words(all(message('stays', []), message('b'), message('c'), message('d')))).toEqual(['stays', 'c', 'd'])
  expect(words(all(message('1', []), message('2', []), message('3', []), message('d')))).toEqual(['1', '2', '3', 'd'])
  expect(words(all(message('1', []), message('2', []), message('3', []), message('d'), message('e')))).toEqual(['1', '2', '3', 'e'])
  expect(words(all(message('1', []), message('2', []), message('3', []), message('d'), message('4', [])))).toEqual(['2', '3', '4'])
  expect(words(all(message('1', []), message('2', []), message('3', []), message('4', [])))).toEqual(['2', '3', '4'])
})

it('what was said of robots that were not known to stand is over when all of them do', () => {
  const toasts = all(message('both', ['a', 'b']), message('for ever', []), message('passing'))
  expect(settled(toasts, ['a', 'c'])).toBe(toasts)
  expect(words(settled(toasts, ['b', 'a']))).toEqual(['for ever', 'passing'])
})
