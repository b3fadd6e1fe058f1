/** Whose page this is.
 *
 * Tabs share the cookie: when somebody logs in or out in another one, what this one asks for is asked by somebody else than
 * the name it shows.
 */
import type { Session } from './types'

const RETRY_MS = 3000

/** What has become of a page's session: still that, begun, over, or somebody else's. */
export type Turn = 'same' | 'in' | 'out' | 'other'

/** @param shown whose page it is
 * @param now whom the relay takes it for
 */
export function turn(shown: Session | null, now: Session | null): Turn {
  if (now === null) return shown === null ? 'same' : 'out'
  if (shown === null) return 'in'
  return shown.user === now.user && shown.realm === now.realm ? 'same' : 'other'
}

/** Asks who is logged in, one question at a time, and until there is an answer. */
export class Checks {
  private asking = false
  private outdated = false
  private retry: ReturnType<typeof setTimeout> | undefined

  constructor(
    private readonly ask: () => Promise<Session | null>,
    private readonly take: (now: Session | null) => void,
  ) {}

  /** There is a reason to ask; an answer to what was asked before it counts no more. */
  look(): void {
    clearTimeout(this.retry)
    this.outdated = this.asking
    if (!this.asking) void this.go()
  }

  /** Who is logged in is known by other means: what was asked before counts no more. */
  known(): void {
    clearTimeout(this.retry)
    this.outdated = this.asking
  }

  private async go(): Promise<void> {
    this.asking = true
    let now: Session | null | undefined
    try {
      now = await this.ask()
    } catch {
      // The relay is away.
    }
    this.asking = false
    if (this.outdated) this.look()
    else if (now === undefined) this.retry = setTimeout(() => this.look(), RETRY_MS)
    else this.take(now)
  }
}

/** Has the tabs of a browser tell each other that somebody has logged in or out. */
export class Tabs {
  private readonly channel = new BroadcastChannel('switchboard:session')

  /** @param heard another tab has told it */
  constructor(heard: () => void) {
    this.channel.onmessage = heard
  }

  tell(): void {
    this.channel.postMessage(null)
  }
}
