/** What all pages share: who is logged in, which page is shown, and messages to the user. */
import { logout, type Credentials, currentSession, login } from './api'
import { afterLogin, parse, type Route } from './route'
import type { Session } from './types'

export interface Toast {
  id: number
  kind: 'info' | 'warning' | 'error'
  words: string
  /** A page of the portal that tells more, and what leads there. */
  more: { path: string; label: string } | null
  /** How often the same was said. */
  times: number
}

const TOAST_MS = 6000
const TOASTS_SHOWN = 3

class App {
  session = $state<Session | null>(null)
  route = $state<Route>({ page: 'unknown' })
  toasts = $state<Toast[]>([])
  /** Words for the login page, e.g. why one has to log in again. */
  notice = $state<string | null>(null)
  private nextToast = 1
  private timers = new Map<number, ReturnType<typeof setTimeout>>()

  /** Finds out who is logged in and shows the page of the address. */
  async start(): Promise<void> {
    this.session = await currentSession()
    this.follow()
  }

  /** Shows the page of the present address; everything but the login page needs a session. */
  follow(): void {
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
    this.go('/login', true)
  }

  /** The session is over; after logging in again the same page is shown. */
  toLogin(notice: string | null): void {
    this.session = null
    this.notice = notice
    const wanted = ['cockpit', 'alerts'].includes(parse(location.pathname).page)
    const here = wanted ? `?next=${encodeURIComponent(location.pathname)}` : ''
    history.replaceState(null, '', `/login${here}`)
    this.route = { page: 'login' }
  }

  tell(kind: Toast['kind'], words: string, more: Toast['more'] = null): void {
    const same = this.toasts.find((toast) => toast.words === words)
    const toast = same ?? { id: this.nextToast++, kind, words, more, times: 0 }
    toast.times += 1
    if (!same) this.toasts = [...this.toasts, toast].slice(-TOASTS_SHOWN)
    clearTimeout(this.timers.get(toast.id))
    this.timers.set(
      toast.id,
      setTimeout(() => this.dismiss(toast.id), TOAST_MS),
    )
  }

  dismiss(id: number): void {
    clearTimeout(this.timers.get(id))
    this.timers.delete(id)
    this.toasts = this.toasts.filter((toast) => toast.id !== id)
  }
}

export const app = new App()
