/** What all pages share: who is logged in, which page is shown, and messages to the user. */
import { logout, type Credentials, currentSession, login } from './api'
import { afterLogin, parse, type Route } from './route'
import { Checks, Tabs, turn } from './session'
import { leave, left } from './storage'
import { added, settled, type Toast } from './toasts'
import type { Session } from './types'

const TOAST_MS = 6000
/** What is told after the page was loaded anew for another user. */
const TURNED = 'turned'

class App {
  session = $state<Session | null>(null)
  /** Whether the relay has said who is logged in, or that nobody is. */
  known = $state(false)
  route = $state<Route>({ page: 'unknown' })
  toasts = $state.raw<Toast[]>([])
  /** Words for the login page, e.g. why one has to log in again. */
  notice = $state<string | null>(null)
  private nextToast = 1
  private timers = new Map<number, ReturnType<typeof setTimeout>>()
  private readonly checks = new Checks(currentSession, (now) => this.turned(now))
  private readonly tabs = new Tabs(() => this.checkSession())

  constructor() {
    document.addEventListener('visibilitychange', () => {
      if (!document.hidden) this.checkSession()
    })
  }

  /** Finds out who is logged in and shows the page of the address. */
  async start(): Promise<void> {
    this.session = await currentSession()
    this.known = true
    this.follow()
    const words = left(TURNED)
    if (words !== null && this.session !== null) this.tell('warning', words)
  }

  /** There is a reason to ask whether whose page this is is still who is logged in. */
  checkSession(): void {
    if (this.known) this.checks.look()
  }

  private turned(now: Session | null): void {
    const what = turn(this.session, now)
    if (what === 'out') this.toLogin('Your session has ended. Please log in again.')
    if (what === 'in') this.enter(now)
    if (what !== 'other' || now === null) return
    // Nothing of what the page has, and nothing that is open, may remain the other user's.
    leave(TURNED, `${now.user} has logged in in another tab. This one is ${now.user}’s now, too.`)
    location.reload()
  }

  private enter(session: Session | null): void {
    // Who has a login link is about to use it.
    if (location.hash !== '') return
    this.session = session
    this.notice = null
    this.go(afterLogin(location.search), true)
  }

  /** Shows the page of the present address, once it is known who looks; all but the login page need a session. */
  follow(): void {
    if (!this.known) return
    const route = parse(location.pathname)
    if (this.session === null && route.page !== 'login') this.toLogin(null)
    else if (this.session !== null && route.page === 'login' && location.hash === '') this.go('/fleet', true)
    else this.route = route
  }

  go(path: string, replace = false): void {
    history[replace ? 'replaceState' : 'pushState'](null, '', path)
    this.follow()
  }

  /** A click on a link of the portal; what opens another tab or window is left to the browser. */
  follows(event: MouseEvent, path: string): void {
    if (event.ctrlKey || event.metaKey || event.shiftKey || event.button !== 0) return
    event.preventDefault()
    this.go(path)
  }

  async login(credentials: Credentials): Promise<void> {
    this.session = await login(credentials)
    this.checks.known()
    this.tabs.tell()
    this.notice = null
    this.go(afterLogin(location.search), true)
  }

  async logout(): Promise<void> {
    try {
      await logout()
    } catch (error) {
      this.tell('error', error instanceof Error ? error.message : String(error))
      return
    }
    this.session = null
    this.checks.known()
    this.tabs.tell()
    this.go('/login', true)
  }

  /** The session is over; after logging in again the same page is shown. */
  toLogin(notice: string | null): void {
    this.session = null
    this.known = true
    this.notice = notice
    const wanted = ['cockpit', 'alerts', 'realm'].includes(parse(location.pathname).page)
    const here = wanted ? `?next=${encodeURIComponent(location.pathname)}` : ''
    history.replaceState(null, '', `/login${here}`)
    this.route = { page: 'login' }
  }

  /** Tells it in a corner of the page.
   *
   * @param until robots: it stays until all of them are known to stand, or it is dismissed; null: for a moment
   */
  tell(kind: Toast['kind'], words: string, more: Toast['more'] = null, until: Toast['until'] = null): void {
    const { toasts, toast } = added(this.toasts, { kind, words, more, until }, this.nextToast++)
    this.toasts = toasts
    clearTimeout(this.timers.get(toast.id))
    if (until !== null) return
    this.timers.set(
      toast.id,
      setTimeout(() => this.dismiss(toast.id), TOAST_MS),
    )
  }

  /** These robots stand, or will be stopped when they are back: that it was not known is said no more. */
  settle(robots: readonly string[]): void {
    const left = settled(this.toasts, robots)
    if (left !== this.toasts) this.toasts = left
  }

  dismiss(id: number): void {
    clearTimeout(this.timers.get(id))
    this.timers.delete(id)
    this.toasts = this.toasts.filter((toast) => toast.id !== id)
  }
}

export const app = new App()
