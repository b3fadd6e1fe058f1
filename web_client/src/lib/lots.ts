/** News in lots: nobody reads a message a second, and the browser shows each. */
import { type Alert, type AlertLevel, isWorse, standing, worst } from './alerts'

/** So long after a lot comes the next, milliseconds. */
export const GAP_MS = 10_000
/** Alerts of one lot; of more the latest are told. */
export const MOST = 1000

/** Hands on the first alert at once, and what comes soon after together; what is worse than was told waits for nothing. */
export class Lots {
  private readonly waiting = new Map<string, Alert>()
  private timer: ReturnType<typeof setTimeout> | undefined
  private told: AlertLevel | null = null

  /** @param tell is given each lot, the oldest first */
  constructor(private readonly tell: (lot: Alert[]) => void) {}

  /** One more piece of news, or several; of an alert that waits already the latest counts. */
  add(alerts: readonly Alert[]): void {
    for (const alert of alerts) {
      this.waiting.delete(alert.id)
      this.waiting.set(alert.id, alert)
    }
    for (const id of [...this.waiting.keys()].slice(0, Math.max(0, this.waiting.size - MOST))) this.waiting.delete(id)
    if (this.timer === undefined || isWorse(this.level(), this.told)) this.go()
  }

  /** Nothing more is told. */
  end(): void {
    clearTimeout(this.timer)
    this.timer = undefined
    this.waiting.clear()
  }

  private level(): AlertLevel | null {
    return worst(standing([...this.waiting.values()]))
  }

  private go(): void {
    clearTimeout(this.timer)
    this.timer = undefined
    this.told = this.level()
    if (this.waiting.size === 0) return
    const lot = [...this.waiting.values()]
    this.waiting.clear()
    this.timer = setTimeout(() => this.go(), GAP_MS)
    this.tell(lot)
  }
}
