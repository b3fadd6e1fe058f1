/** The user's robots and their alerts, followed for as long as he is logged in, whatever page is shown. */
import { fleetStream } from './api'
import { type Alert, News, standing, summary, waiting, worst } from './alerts'
import { app } from './app.svelte'
import { Lots } from './lots'
import { notify } from './notify'
import { ALERTS } from './route'
import type { Robot } from './types'

/** A loss shorter than this is not spoken of. */
const LOSS_SHOWN_S = 1
const TONES = { error: 'error', warning: 'warning', info: 'info' } as const

class Watch {
  /** Null before the relay told them. */
  robots = $state.raw<Robot[] | null>(null)
  /** Those that are open, or were over a moment ago; the latest first. */
  alerts = $state.raw<Alert[]>([])
  /** Since when nothing is known of how things are, Unix seconds: there is no connection, or the relay itself can't tell. */
  lostSince = $state<number | null>(null)
  /** Why the relay, which is there, can't tell how things are. */
  unknown = $state<string | null>(null)
  /** What the relay said when it last closed the connection; empty for nothing. */
  why = $state('')

  /** How many alerts nobody looks after. */
  readonly waiting = $derived(waiting(this.alerts))

  private news = new News()
  private readonly lots = new Lots((lot) => {
    app.tell(TONES[worst(standing(lot)) ?? 'info'], summary(lot), { path: ALERTS, label: 'Show alerts' })
    notify(lot)
  })

  /** Begins, and goes on until the returned function is called. */
  open(): () => void {
    this.news = new News()
    const stream = fleetStream(
      {
        robots: (list) => this.takeRobots(list),
        alerts: (list) => this.takeAlerts(list),
        unknown: (why) => this.lose(0, why),
        silent: (ms) => this.lose(ms, null),
        gone: (why) => {
          this.why = why
          this.lose(0, null)
          // A refusal may be about a session that is over, or another user's by now.
          app.checkSession()
        },
      },
      location,
    )
    const retry = () => stream.retryNow()
    window.addEventListener('online', retry)
    stream.open()
    return () => {
      window.removeEventListener('online', retry)
      stream.close()
      this.lots.end()
      this.robots = null
      this.alerts = []
      this.lostSince = this.unknown = null
      this.why = ''
    }
  }

  /** Whether nothing has been known for so long that the page says so; at a Unix time in seconds. */
  isLost(now: number): boolean {
    return this.lostSince !== null && now - this.lostSince > LOSS_SHOWN_S
  }

  private lose(msAgo: number, unknown: string | null): void {
    this.lostSince ??= (Date.now() - msAgo) / 1000
    this.unknown = unknown
  }

  private takeRobots(list: Robot[]): void {
    this.robots = list
    this.lostSince = this.unknown = null
    this.why = ''
  }

  private takeAlerts(list: Alert[]): void {
    this.alerts = list
    this.lots.add(this.news.take(list))
  }
}

export const watch = new Watch()
