/** Numbers, times and messages as text. */

const NONE = '–'

export function number(value: number | null | undefined, digits: number): string {
  if (value === null || value === undefined || !Number.isFinite(value)) return NONE
  const text = value.toFixed(digits)
  return Number(text) === 0 ? (0).toFixed(digits) : text.replace('-', '−')
}

export function milliseconds(value: number | null | undefined): string {
  if (value === null || value === undefined || !Number.isFinite(value)) return NONE
  return value < 1 ? '< 1 ms' : `${Math.round(value)} ms`
}

export function percent(share: number | null | undefined): string {
  if (share === null || share === undefined || !Number.isFinite(share)) return NONE
  return `${Math.round(Math.max(0, Math.min(1, share)) * 100)} %`
}

export function hertz(value: number): string {
  if (value <= 0) return '0 Hz'
  return value < 10 ? `${value.toFixed(1)} Hz` : `${Math.round(value)} Hz`
}

export function bytesPerSecond(value: number): string {
  if (value < 1e6) return `${Math.round(value / 1000)} kB/s`
  return `${(value / 1e6).toFixed(value < 1e7 ? 1 : 0)} MB/s`
}

/** A size in decimal units. */
export function fileSize(bytes: number): string {
  const units: [number, string][] = [
    [1e9, 'GB'],
    [1e6, 'MB'],
    [1e3, 'kB'],
  ]
  for (const [unit, name] of units) {
    // A value that would be rounded to 1000 gets the next unit.
    if (bytes >= unit * 0.9995) return `${(bytes / unit).toFixed(bytes < unit * 99.95 ? 1 : 0).replace(/\.0$/, '')} ${name}`
  }
  return `${bytes} B`
}

/** A duration as on a stopwatch: 0:42, 12:05, 1:02:03. */
export function stopwatch(seconds: number): string {
  const whole = Math.max(0, Math.floor(seconds))
  const parts = [Math.floor(whole / 60) % 60, whole % 60]
  const hours = Math.floor(whole / 3600)
  const [first, ...rest] = hours > 0 ? [hours, ...parts] : parts
  return [first, ...rest.map((part) => String(part).padStart(2, '0'))].join(':')
}

/** A whole number with its thousands separated. */
export function count(value: number): string {
  return String(value).replace(/\B(?=(\d{3})+$)/g, '\u202f')
}

/** Date and time; with the year if it is not the present one. Both arguments in Unix seconds. */
export function moment(then: number, now: number): string {
  const [at, today] = [new Date(then * 1000), new Date(now * 1000)]
  const year = at.getFullYear() === today.getFullYear() ? undefined : 'numeric'
  return at.toLocaleString(undefined, { year, month: 'short', day: 'numeric', hour: 'numeric', minute: '2-digit' })
}

/** Time of the day; with its date unless it is the present one. Both arguments in Unix seconds. */
export function timeOfDay(then: number, now: number): string {
  const [at, today] = [new Date(then * 1000), new Date(now * 1000)]
  if (at.toDateString() !== today.toDateString()) return moment(then, now)
  return at.toLocaleTimeString(undefined, { hour: 'numeric', minute: '2-digit', second: '2-digit' })
}

/** Time since a moment, in words. Both arguments in Unix seconds. */
export function ago(then: number | null, now: number): string {
  if (then === null) return 'never'
  const seconds = Math.max(0, Math.round(now - then))
  if (seconds < 5) return 'just now'
  if (seconds < 60) return `${seconds} s ago`
  if (seconds < 3600) return `${Math.floor(seconds / 60)} min ago`
  if (seconds < 86_400) return `${Math.floor(seconds / 3600)} h ago`
  const days = Math.floor(seconds / 86_400)
  return days === 1 ? 'a day ago' : `${days} days ago`
}

/** Duration since a moment, in words. Both arguments in Unix seconds. */
export function lasting(since: number, now: number): string {
  const words = ago(since, now)
  return words === 'just now' ? 'a moment' : words.replace(/ ago$/, '')
}

/** Names in a sentence, each once: "ann, bob and 2 more". */
export function people(names: string[], shown = 2): string {
  const once = Array.from(new Set(names))
  if (once.length === 0) return 'nobody'
  if (once.length <= shown) return once.join(', ')
  return `${once.slice(0, shown).join(', ')} and ${once.length - shown} more`
}

/** A message of the relay as a sentence, with a capital letter and a full stop. */
export function sentence(text: string): string {
  const trimmed = text.trim()
  const begun = trimmed.charAt(0).toUpperCase() + trimmed.slice(1)
  return begun === '' || /[.!?…]$/.test(begun) ? begun : `${begun}.`
}

const ARRAY_SHOWN = 6
const STRING_SHOWN = 120
const LINES_SHOWN = 400
const DEPTH_SHOWN = 24

/** A message as indented JSON. Long arrays and strings are shortened, with their full length. */
export function pretty(message: unknown): string {
  const lines: string[] = []
  write(message, '', '', lines, 0)
  if (lines.length <= LINES_SHOWN) return lines.join('\n')
  return [...lines.slice(0, LINES_SHOWN), `… ${lines.length - LINES_SHOWN} more lines`].join('\n')
}

function write(value: unknown, lead: string, tail: string, lines: string[], depth: number): void {
  const indent = '  '.repeat(depth)
  // Further lines would be cut off later.
  if (depth > DEPTH_SHOWN || lines.length > LINES_SHOWN * 4) {
    lines.push(`${indent}${lead}…${tail}`)
    return
  }
  if (Array.isArray(value)) writeArray(value, lead, tail, lines, depth)
  else if (typeof value === 'object' && value !== null) writeObject(value, lead, tail, lines, depth)
  else lines.push(`${indent}${lead}${scalar(value)}${tail}`)
}

function writeArray(value: unknown[], lead: string, tail: string, lines: string[], depth: number): void {
  const indent = '  '.repeat(depth)
  const shown = value.slice(0, ARRAY_SHOWN)
  const more = value.length - shown.length
  if (shown.every((item) => typeof item !== 'object' || item === null)) {
    const rest = more > 0 ? [`… ${more} more`] : []
    lines.push(`${indent}${lead}[${[...shown.map(scalar), ...rest].join(', ')}]${tail}`)
    return
  }
  lines.push(`${indent}${lead}[`)
  shown.forEach((item, i) => write(item, '', i < value.length - 1 ? ',' : '', lines, depth + 1))
  if (more > 0) lines.push(`${indent}  … ${more} more`)
  lines.push(`${indent}]${tail}`)
}

function writeObject(value: object, lead: string, tail: string, lines: string[], depth: number): void {
  const entries = Object.entries(value)
  const indent = '  '.repeat(depth)
  if (entries.length === 0) {
    lines.push(`${indent}${lead}{}${tail}`)
    return
  }
  lines.push(`${indent}${lead}{`)
  entries.forEach(([key, item], i) => {
    write(item, `${JSON.stringify(key)}: `, i < entries.length - 1 ? ',' : '', lines, depth + 1)
  })
  lines.push(`${indent}}${tail}`)
}

function scalar(value: unknown): string {
  if (typeof value === 'string' && value.length > STRING_SHOWN) {
    return `${JSON.stringify(value.slice(0, STRING_SHOWN))} … ${value.length} characters`
  }
  return JSON.stringify(value) ?? 'null'
}
