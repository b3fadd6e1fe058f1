import { describe, expect, it } from 'vitest'
import { EventLines, readEvents } from './events'

function events(...parts: string[]): [string, string][] {
  const found: [string, string][] = []
  const lines = new EventLines((name, data) => found.push([name, data]))
  parts.forEach((part) => lines.add(part))
  return found
}

describe('EventLines', () => {
  it('reads events that come in any pieces', () => {
    const text = 'event: lines\ndata: {"a":1}\n\n: comment\n\nid: 7\nevent: ended\ndata: "no right"\n\n'
    const whole = [
      ['lines', '{"a":1}'],
      ['ended', '"no right"'],
    ]
    expect(events(text)).toEqual(whole)
    expect(events(...text)).toEqual(whole)
  })

  it('keeps an event that is incomplete', () => {
    expect(events('event: lines\ndata: 1\n')).toEqual([])
  })
})

describe('readEvents', () => {
  it('passes on decoded data until the end', async () => {
    const found: [string, unknown][] = []
    await readEvents(new Response('event: a\ndata: {"b":[1]}\n\n'), (name, data) => found.push([name, data]))
    expect(found).toEqual([['a', { b: [1] }]])
  })
})
