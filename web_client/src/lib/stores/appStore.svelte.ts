/** State shared by all pages: the user, the page shown, and messages. */
import { logout, currentSession, login } from '../api/api'
import { afterLogin, parse, type Route } from '../route'
import { Checks, Tabs, turn } from '../api/session'
import { leave, left } from './storage'
import { added, settled, type Toast } from './toasts'
import type { Credentials, Session } from '../api/types'

const TOAST_MS = 6000
/** Message after a reload for another user. */
const TURNED = 'turned'

class App {
  session = $state<Session | null>(null)
  /** Whether the user of the session is known. */
  known = $state(false)
  route = $state<Route>({ page: 'unknown' })
  toasts = $state.raw<Toast[]>([])
  /** Message on the login page, e.g. why a new login is needed. */
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

  /** Asks which user is logged in, and shows the page of the URL. */
  async start(): Promise<void> {
    this.session = await currentSession()
    this.known = true
    this.follow()
    const words = left(TURNED)
    if (words !== null && this.session !== null) this.notify('warning', words)
  }

  /** Checks whether the user of this page is still logged in. */
  checkSession(): void {
    if (this.known) this.checks.refresh()
  }

  private turned(now: Session | null): void {
    const what = turn(this.session, now)
    if (what === 'out') this.toLogin('Your session has ended. Please log in again.')
    if (what === 'in') this.enter(now)
    if (what !== 'other' || now === null) return
    // No state or connection of the previous user may remain.
    leave(TURNED, `${now.user} has logged in in another tab. This tab belongs to ${now.user} now, too.`)
    location.reload()
  }

  private enter(session: Session | null): void {
    // A login link will be used.
    if (location.hash !== '') return
    this.session = session
    this.notice = null
    this.go(afterLogin(location.search), true)
  }

  /** Shows the page of the present address, once the user is known. All pages except login need a session. */
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

  /** Handles a click on a link of the portal. Clicks that open another tab or window are left to the browser. */
  follows(event: MouseEvent, path: string): void {
    if (event.ctrlKey || event.metaKey || event.shiftKey || event.button !== 0) return
    event.preventDefault()
    this.go(path)
  }

  async login(credentials: Credentials): Promise<void> {
    this.session = await login(credentials)
    this.checks.known()
    this.tabs.broadcast()
    this.notice = null
    this.go(afterLogin(location.search), true)
  }

  async logout(): Promise<void> {
    try {
      await logout()
    } catch (error) {
      this.notify('error', error instanceof Error ? error.message : String(error))
      return
    }
    this.session = null
    this.checks.known()
    this.tabs.broadcast()
    this.go('/login', true)
  }

  /** The session has ended; after the next login the same page is shown. */
  toLogin(notice: string | null): void {
    this.session = null
    this.known = true
    this.notice = notice
    const wanted = ['cockpit', 'alerts', 'diagram', 'realm'].includes(parse(location.pathname).page)
    const here = wanted ? `?next=${encodeURIComponent(location.pathname)}` : ''
    history.replaceState(null, '', `/login${here}`)
    this.route = { page: 'login' }
  }

  /** Shows a message in a corner of the page.
   *
   * @param until robots: the message stays until all of them are known to be stopped, or it is dismissed; null: for a moment
   */
  notify(kind: Toast['kind'], words: string, more: Toast['more'] = null, until: Toast['until'] = null): void {
    const { toasts, toast } = added(this.toasts, { kind, words, more, until }, this.nextToast++)
    this.toasts = toasts
    clearTimeout(this.timers.get(toast.id))
    if (until !== null) return
    this.timers.set(
      toast.id,
      setTimeout(() => this.dismiss(toast.id), TOAST_MS),
    )
  }

  /** Removes messages about robots whose stop was not confirmed, and now is, or is pending. */
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
