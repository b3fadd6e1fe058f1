/** The user of this page.
 *
 * Tabs share the cookie. After a login in another tab, requests of this one would be sent as a user that it does not show.
 */
import type { Session } from './types'

const RETRY_MS = 3000

/** State of a page's session: unchanged, begun, ended, or of another user. */
export type Turn = 'same' | 'in' | 'out' | 'other'

/** @param shown the user that the page shows
 * @param now the user of the session cookie
 */
export function turn(shown: Session | null, now: Session | null): Turn {
  if (now === null) return shown === null ? 'same' : 'out'
  if (shown === null) return 'in'
  return shown.user === now.user && shown.realm === now.realm ? 'same' : 'other'
}

/** Asks which user is logged in, one request at a time, until there is an answer. */
export class Checks {
  private asking = false
  private outdated = false
  private retry: ReturnType<typeof setTimeout> | undefined

  constructor(
    private readonly ask: () => Promise<Session | null>,
    private readonly take: (now: Session | null) => void,
  ) {}

  /** Ask again; answers to earlier requests are ignored. */
  refresh(): void {
    clearTimeout(this.retry)
    this.outdated = this.asking
    if (!this.asking) void this.request()
  }

  /** The user is known by a login or logout; answers to earlier requests are ignored. */
  known(): void {
    clearTimeout(this.retry)
    this.outdated = this.asking
  }

  private async request(): Promise<void> {
    this.asking = true
    let now: Session | null | undefined
    try {
      now = await this.ask()
    } catch {
      // The relay does not answer.
    }
    this.asking = false
    if (this.outdated) this.refresh()
    else if (now === undefined) this.retry = setTimeout(() => this.refresh(), RETRY_MS)
    else this.take(now)
  }
}

/** Notifies the other tabs of the browser of login and logout. */
export class Tabs {
  private readonly channel = new BroadcastChannel('switchboard:session')

  /** @param onMessage called when another tab sends a notification */
  constructor(onMessage: () => void) {
    this.channel.onmessage = onMessage
  }

  broadcast(): void {
    this.channel.postMessage(null)
  }
}
