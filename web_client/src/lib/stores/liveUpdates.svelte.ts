/** The user's robots and alerts, updated while logged in, on every page. */
import { fleetStream } from '../api/api'
import { News, standing, summary, waiting, worst } from '../api/alerts'
import { app } from './appStore.svelte.ts'
import { AlertBatch } from './alertBatching'
import { notify } from './notifications'
import { ALERTS } from '../route'
import type { Alert, Order, Robot } from '../api/types'
import type { Stream } from '../api/updates'
import { relayTime } from '../relayClock'

/** A shorter loss is not shown, milliseconds. */
const LOSS_SHOWN_S = 1
const TONES = { error: 'error', warning: 'warning', info: 'info' } as const

class Watch {
  /** Null before the relay sent them. */
  robots = $state.raw<Robot[] | null>(null)
  /** Alerts that are open, or ended a moment ago; the latest first. */
  alerts = $state.raw<Alert[]>([])
  /** Unix seconds since when the state is unknown: no connection, or the relay does not know it. */
  lostSince = $state<number | null>(null)
  /** Why the reachable relay does not know the state. */
  unknown = $state<string | null>(null)
  /** Reason of the relay for the last close; empty for none. */
  why = $state('')

  /** Number of alerts that are not acknowledged. */
  readonly waiting = $derived(waiting(this.alerts))

  private stream: Stream | null = null
  private news = new News()
  private readonly lots = new AlertBatch((lot) => {
    app.notify(TONES[worst(standing(lot)) ?? 'info'], summary(lot), { path: ALERTS, label: 'Show alerts' })
    notify(lot)
  })

  /** Begins to follow updates until the returned function is called. */
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
          // After a refusal, the session may have ended or belong to another user.
          app.checkSession()
        },
      },
      location,
    )
    this.stream = stream
    const retry = () => stream.retryNow()
    window.addEventListener('online', retry)
    stream.open()
    return () => {
      window.removeEventListener('online', retry)
      stream.close()
      this.stream = null
      this.lots.end()
      this.robots = null
      this.alerts = []
      this.lostSince = this.unknown = null
      this.why = ''
    }
  }

  /** Sends an order to stop on the websocket of the updates, if it is open. Its answer is not awaited: the updates show it. */
  order(stop: Order): void {
    this.stream?.send(stop)
  }

  /** Whether the state has been unknown for so long that the page shows it; at a Unix time in seconds. */
  isLost(now: number): boolean {
    return this.lostSince !== null && now - this.lostSince > LOSS_SHOWN_S
  }

  private lose(msAgo: number, unknown: string | null): void {
    this.lostSince ??= relayTime() - msAgo / 1000
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
