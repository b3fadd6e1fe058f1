/** Pages of a module's log, as they are shown: the oldest first, without a gap but where lines were lost. */
import type { LogLine, LogPage } from './api/types'

export const LEVELS = ['debug', 'info', 'warn', 'error', 'fatal'] as const
export type Level = LogLine['level']

/** Most lines while the newest are in sight, and while earlier ones are read. */
const MOST_AT_END = 1000
const MOST = 10_000

/** With one more page at the end; the oldest pages are dropped when there are too many lines. */
export function append(pages: LogPage[], page: LogPage, atEnd: boolean): LogPage[] {
  const found = [...pages, page]
  let lines = found.reduce((sum, each) => sum + each.lines.length, 0)
  let drop = 0
  while (drop < found.length - 1 && lines - found[drop]!.lines.length >= (atEnd ? MOST_AT_END : MOST)) {
    lines -= found[drop]!.lines.length
    drop += 1
  }
  return found.slice(drop)
}

/** `before` of the request for the lines in front of those shown; 0 if there are none. */
export function earlier(pages: LogPage[]): number {
  return pages[0]?.previous ?? 0
}

/** The lines of a level, and those that are more severe. */
export function ofLevel(lines: LogLine[], level: Level): LogLine[] {
  const least = LEVELS.indexOf(level)
  return least === 0 ? lines : lines.filter((line) => LEVELS.indexOf(line.level) >= least)
}
