/** Streams of server-sent events (WHATWG HTML section 9.2). They are read with fetch, which shows the relay's refusal. */
import { Unreachable } from './request'

/** Splits a stream of text into events. */
export class EventLines {
  private rest = ''
  private name = 'message'
  private data: string[] = []

  constructor(private readonly take: (name: string, data: string) => void) {}

  add(text: string): void {
    const lines = (this.rest + text).split('\n')
    this.rest = lines.pop() ?? ''
    lines.forEach((line) => this.line(line))
  }

  private line(line: string): void {
    if (line === '') {
      if (this.data.length > 0) this.take(this.name, this.data.join('\n'))
      this.name = 'message'
      this.data = []
    } else if (line.startsWith('event: ')) this.name = line.slice(7)
    else if (line.startsWith('data: ')) this.data.push(line.slice(6))
  }
}

/** Passes on each event until the stream ends.
 *
 * @throws Unreachable when it breaks off
 */
export async function readEvents(answer: Response, take: (name: string, data: unknown) => void): Promise<void> {
  const lines = new EventLines((name, data) => take(name, JSON.parse(data)))
  const words = new TextDecoder()
  const reader = answer.body?.getReader()
  const next = () => reader?.read().catch(() => Promise.reject(new Unreachable()))
  for (let part = await next(); part !== undefined && !part.done; part = await next()) {
    lines.add(words.decode(part.value, { stream: true }))
  }
}
