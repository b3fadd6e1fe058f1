import { describe, expect, it } from 'vitest'
import type { LogLine, LogPage } from './api/types'
import { append, earlier, LEVELS, ofLevel } from './logPages'

const line = (level: LogLine['level']): LogLine => ({ at: 1, stream: 'out', level, text: level })
const page = (previous: number, lines: number): LogPage => ({
  lines: Array.from({ length: lines }, () => line('info')),
  previous,
  next: previous + lines,
  missed: false,
})

describe('append', () => {
  it('drops the oldest pages while the newest lines are in sight, and the earlier ones can be read again', () => {
    let pages: LogPage[] = []
    for (let number = 0; number < 30; number++) pages = append(pages, page(number * 100, 100), true)
    expect(pages.map(({ previous }) => previous)).toEqual(Array.from({ length: 10 }, (_, number) => 2000 + number * 100))
    expect(earlier(pages)).toBe(2000)
  })

  it('keeps more of them while earlier lines are read', () => {
    let pages: LogPage[] = []
    for (let number = 0; number < 130; number++) pages = append(pages, page(number * 100, 100), false)
    expect(pages).toHaveLength(100)
  })

  it('keeps the last page however long it is', () => {
    expect(append([page(0, 5)], page(5, 2000), true)).toHaveLength(1)
  })
})

it('has no earlier lines without a page', () => {
  expect(earlier([])).toBe(0)
})

it('shows lines of a level and more severe ones', () => {
  const lines = LEVELS.map(line)
  expect(ofLevel(lines, 'warn').map(({ level }) => level)).toEqual(['warn', 'error', 'fatal'])
  expect(ofLevel(lines, 'debug')).toBe(lines)
})
