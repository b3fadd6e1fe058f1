/** The recordings of one robot, followed for as long as its cockpit is open. */
import * as api from './api'
import { app } from './app.svelte'
import { isRunning } from './recordings'
import type { Possible, Recording, RecordingAsk } from './types'

const RUNNING_MS = 1000
const QUIET_MS = 5000
/** For who has no right to any of it: one may be given to him. */
const DENIED_MS = 15_000
/** Shown at first, and so many more each time older ones are asked for. */
const PAGE = 100

export class Recordings {
  /** Those the user may have, the latest first; null before the relay told them. */
  list = $state.raw<Recording[] | null>(null)
  /** Whether there are older ones than are in the list. */
  more = $state(false)
  /** What could be recorded now; null before the relay told it. */
  possible = $state.raw<Possible | null>(null)
  private timer: ReturnType<typeof setTimeout> | undefined
  private closed = false
  private askedMs = -Infinity
  private most = PAGE

  constructor(readonly robot: string) {}

  open(): void {
    void this.follow()
  }

  close(): void {
    this.closed = true
    clearTimeout(this.timer)
  }

  /** Begins one; throws the relay's refusal in words. */
  async start(ask: RecordingAsk): Promise<void> {
    await api.startRecording(this.robot, ask)
    await this.look(true)
  }

  /** Has older ones in the list as well. */
  async older(): Promise<void> {
    this.most += PAGE
    await this.look(false)
  }

  async stop(id: string): Promise<void> {
    await this.told(api.stopRecording(this.robot, id))
  }

  async remove(id: string): Promise<void> {
    await this.told(api.deleteRecording(this.robot, id))
  }

  private async told(work: Promise<void>): Promise<void> {
    try {
      await work
    } catch (error) {
      app.tell('error', error instanceof Error ? error.message : String(error))
    }
    await this.look(true)
  }

  private async follow(): Promise<void> {
    if (!document.hidden) await this.look(performance.now() - this.askedMs >= QUIET_MS)
    if (this.closed) return
    this.timer = setTimeout(() => void this.follow(), this.pause())
  }

  private pause(): number {
    if (this.list?.some(isRunning)) return RUNNING_MS
    return this.list?.length === 0 && this.possible?.denied ? DENIED_MS : QUIET_MS
  }

  private async look(all: boolean): Promise<void> {
    try {
      if (all) {
        this.askedMs = performance.now()
        this.possible = await api.recordable(this.robot)
      }
      const { list, more } = await api.recordings(this.robot, this.most)
      this.list = list
      this.more = more
    } catch {
      // Asked again in a moment; a lost relay or right is told by the cockpit's own link.
    }
  }
}
