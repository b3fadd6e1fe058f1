/** The recordings of one robot, updated while its cockpit is open. */
import * as api from '../api/api'
import { app } from './appStore.svelte.ts'
import { isRunning } from '../api/recordings'
import type { Recordable, Recording, RecordingRequest } from '../api/types'

const RUNNING_MS = 1000
const QUIET_MS = 5000
/** Interval for users without the right, which may be granted later. */
const DENIED_MS = 15_000
/** Number of recordings at first, and of further ones for each press. */
const PAGE = 100

export class Recordings {
  /** Recordings the user may download, the latest first; null before the relay sent them. */
  list = $state.raw<Recording[] | null>(null)
  /** Whether there are older ones than the listed ones. */
  more = $state(false)
  /** Topics and cameras that can be recorded now; null before the relay sent them. */
  possible = $state.raw<Recordable | null>(null)
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

  /** Begins a recording; throws the relay's refusal. */
  async start(ask: RecordingRequest): Promise<void> {
    await api.startRecording(this.robot, ask)
    await this.refresh(true)
  }

  /** Loads older recordings too. */
  async older(): Promise<void> {
    this.most += PAGE
    await this.refresh(false)
  }

  async stop(id: string): Promise<void> {
    await this.withNotice(api.stopRecording(this.robot, id))
  }

  async remove(id: string): Promise<void> {
    await this.withNotice(api.deleteRecording(this.robot, id))
  }

  private async withNotice(work: Promise<void>): Promise<void> {
    try {
      await work
    } catch (error) {
      app.notify('error', error instanceof Error ? error.message : String(error))
    }
    await this.refresh(true)
  }

  private async follow(): Promise<void> {
    if (!document.hidden) await this.refresh(performance.now() - this.askedMs >= QUIET_MS)
    if (this.closed) return
    this.timer = setTimeout(() => void this.follow(), this.pause())
  }

  private pause(): number {
    if (this.list?.some(isRunning)) return RUNNING_MS
    return this.list?.length === 0 && this.possible?.denied ? DENIED_MS : QUIET_MS
  }

  private async refresh(all: boolean): Promise<void> {
    try {
      if (all) {
        this.askedMs = performance.now()
        this.possible = await api.recordable(this.robot)
      }
      const { list, more } = await api.recordings(this.robot, this.most)
      this.list = list
      this.more = more
    } catch {
      // Requested again soon; the cockpit reports a lost relay or right.
    }
  }
}
