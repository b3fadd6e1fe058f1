/** The user's robots and their alerts, followed for as long as he is logged in, whatever page is shown. */
import { currentSession, watchFleet } from './api'
import { type Alert, News, standing, summary, waiting, worst } from './alerts'
import { app } from './app.svelte'
import { Lots } from './lots'
import { notify } from './notify'
import { ALERTS } from './route'
import type { Robot } from './types'

const RETRY_MS = 2000
/** A loss shorter than this is not spoken of. */
const LOSS_SHOWN_S = 1
const TONES = { error: 'error', warning: 'warning', info: 'info' } as const

class Watch {
  /** Null before the relay told them. */
  robots = $state.raw<Robot[] | null>(null)
  /** Those that are open, or were over a moment ago; the latest first. */
  alerts = $state.raw<Alert[]>([])
  /** Since when there is no connection, Unix seconds. */
  lostSince = $state<number | null>(null)

  /** How many alerts nobody looks after. */
  readonly waiting = $derived(waiting(this.alerts))

  private news = new News()
  private readonly lots = new Lots((lot) => {
    app.tell(TONES[worst(standing(lot)) ?? 'info'], summary(lot), { path: ALERTS, label: 'Show alerts' })
    notify(lot)
  })
  private end: () => void = () => {}
  private retry: ReturnType<typeof setTimeout> | undefined

  /** Begins, and goes on until the returned function is called. */
  open(): () => void {
    this.news = new News()
    this.follow()
    return () => {
      this.end()
      clearTimeout(this.retry)
      this.lots.end()
      this.robots = null
      this.alerts = []
      this.lostSince = null
    }
  }

  /** Whether there has been no connection for so long that the page says so; at a Unix time in seconds. */
  isLost(now: number): boolean {
    return this.lostSince !== null && now - this.lostSince > LOSS_SHOWN_S
  }

  private follow(): void {
    this.end()
    this.end = watchFleet({
      robots: (list) => {
        this.robots = list
        this.lostSince = null
      },
      alerts: (list) => this.take(list),
      lost: (final) => {
        this.lostSince ??= Date.now() / 1000
        if (final) this.retry = setTimeout(() => void this.again(), RETRY_MS)
      },
    })
  }

  private async again(): Promise<void> {
    try {
      if ((await currentSession()) === null) {
        app.toLogin('Your session has ended. Please log in again.')
        return
      }
    } catch {
      // The relay is away; the next attempt tells.
    }
    this.follow()
  }

  private take(list: Alert[]): void {
    this.alerts = list
    this.lots.add(this.news.take(list))
  }
}

export const watch = new Watch()
