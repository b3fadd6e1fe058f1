/** Batches of alerts, so that there are not too many notifications. */
import { isWorse, standing, worst } from '../api/alerts'
import type { Alert, AlertLevel } from '../api/types'

/** Least time between two batches, milliseconds. */
export const GAP_MS = 10_000
/** Most alerts of a batch; of more, the latest are shown. */
export const MOST = 1000

/** Passes on the first alert at once, later ones in a batch; a more severe one is never delayed. */
export class AlertBatch {
  private readonly waiting = new Map<string, Alert>()
  private timer: ReturnType<typeof setTimeout> | undefined
  private announced: AlertLevel | null = null

  /** @param announce receives each batch, the oldest alert first */
  constructor(private readonly announce: (batch: Alert[]) => void) {}

  /** Adds alerts. Of an alert that waits already, the latest state counts. */
  add(alerts: readonly Alert[]): void {
    for (const alert of alerts) {
      this.waiting.delete(alert.id)
      this.waiting.set(alert.id, alert)
    }
    for (const id of [...this.waiting.keys()].slice(0, Math.max(0, this.waiting.size - MOST))) this.waiting.delete(id)
    if (this.timer === undefined || isWorse(this.level(), this.announced)) this.flush()
  }

  /** Ends batching. */
  end(): void {
    clearTimeout(this.timer)
    this.timer = undefined
    this.waiting.clear()
  }

  private level(): AlertLevel | null {
    return worst(standing([...this.waiting.values()]))
  }

  private flush(): void {
    clearTimeout(this.timer)
    this.timer = undefined
    this.announced = this.level()
    if (this.waiting.size === 0) return
    const batch = [...this.waiting.values()]
    this.waiting.clear()
    this.timer = setTimeout(() => this.flush(), GAP_MS)
    this.announce(batch)
  }
}
