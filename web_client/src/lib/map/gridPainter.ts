/** Hands grids to the worker one after another; of those that wait only the newest is drawn. */
import type { GridJob, GridPicture } from './gridWorker'

export type WorkerPort = Pick<Worker, 'postMessage' | 'terminate' | 'onmessage' | 'onerror'>

export class GridPainter {
  private worker: WorkerPort | null = null
  private busy = false
  private waiting: GridJob | null = null

  /**
   * @param drawn gets each picture; its bitmaps belong to the receiver
   * @param failed gets the reason in words
   */
  constructor(
    private readonly drawn: (picture: GridPicture) => void,
    private readonly failed: (reason: string) => void,
    private readonly open: () => WorkerPort = () => new Worker(new URL('./gridWorker.ts', import.meta.url), { type: 'module' }),
  ) {}

  paint(job: GridJob): void {
    if (job.cells.data.length === 0) return
    this.waiting = job
    this.next()
  }

  close(): void {
    this.worker?.terminate()
    this.worker = null
    this.waiting = null
    this.busy = false
  }

  private next(): void {
    const job = this.waiting
    if (job === null || this.busy) return
    this.waiting = null
    this.busy = true
    this.worker ??= this.opened()
    this.worker.postMessage(job)
  }

  private opened(): WorkerPort {
    const worker = this.open()
    worker.onmessage = ({ data }: MessageEvent<GridPicture | { failed: string }>) => {
      this.busy = false
      if ('failed' in data) this.failed(data.failed)
      else this.drawn(data)
      this.next()
    }
    worker.onerror = () => {
      this.close()
      this.failed('The map could not be drawn.')
    }
    return worker
  }
}
