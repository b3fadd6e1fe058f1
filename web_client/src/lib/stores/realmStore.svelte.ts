/** State of the administration page: lists that are loaded in parts, and actions. */
import { app } from './appStore.svelte.ts'
import { administrators, why, type Directory } from '../api/administration'
import { about, fetchAllPages, groups, Superseded, users, type Asked, type Part } from '../api/realm'
import { Refusal } from '../api/request'
import type { RealmAbout } from '../api/types'

const PART = 100
/** Pause after which typing counts as finished. */
const PAUSE_MS = 250
/** Names to choose from; others can be typed. */
const KNOWN = 5000

/** An action, and why it failed. */
export class Attempt {
  busy = $state(false)
  failure = $state<string | null>(null)

  /** Whether it succeeded; a failure is shown, and the input is kept. */
  async run(work: () => Promise<unknown>): Promise<boolean> {
    if (this.busy) return false
    this.busy = true
    this.failure = null
    try {
      await work()
      return true
    } catch (error) {
      this.failure = why(error)
      // The element of the message disappears.
      if (error instanceof Superseded && error.gone) app.notify('error', this.failure)
      if (error instanceof Refusal && error.status === 401) app.checkSession()
      return false
    } finally {
      this.busy = false
    }
  }
}

/** A list that is loaded as far as needed, and again when it may have changed. */
export class Listed<T> {
  /** Null before the relay sent it. */
  items = $state.raw<T[] | null>(null)
  more = $state(false)
  busy = $state(false)
  failure = $state<string | null>(null)
  private most: number
  private latest = 0
  private timer: ReturnType<typeof setTimeout> | undefined

  /** @param step number of items at first, and further ones for each press */
  constructor(
    private readonly ask: (asked: Asked) => Promise<Part<T>>,
    private readonly step = PART,
  ) {
    this.most = step
  }

  /** Loads the present list. */
  async refresh(): Promise<void> {
    clearTimeout(this.timer)
    const mine = ++this.latest
    this.busy = true
    try {
      const { items, next } = await fetchAllPages(this.ask, this.most)
      if (mine !== this.latest) return
      this.items = items
      this.more = next !== ''
      this.failure = null
    } catch (error) {
      if (mine !== this.latest) return
      this.failure = why(error)
      if (error instanceof Refusal && error.status === 401) app.checkSession()
    }
    this.busy = false
  }

  async older(): Promise<void> {
    this.most += this.step
    await this.refresh()
  }

  /** The filter changed: the list is loaded again after a pause in typing. */
  filter(): void {
    this.most = this.step
    clearTimeout(this.timer)
    this.timer = setTimeout(() => void this.refresh(), PAUSE_MS)
  }

  close(): void {
    clearTimeout(this.timer)
    this.latest += 1
  }
}

/** The realm, with its users and groups. */
export class Realm {
  about = $state.raw<RealmAbout | null>(null)
  directory = $state.raw<Directory>({ users: [], groups: [] })
  readonly administrators = $derived(administrators(this.directory))

  /** Loads everything again. */
  async refresh(): Promise<void> {
    try {
      this.about = await about()
    } catch {
      // The list beside it shows the reason.
    }
  }

  /** Loads the users and groups to choose from. */
  async know(): Promise<void> {
    try {
      const [people, crews] = await Promise.all([fetchAllPages(users, KNOWN), fetchAllPages(groups, KNOWN)])
      this.directory = { users: people.items, groups: crews.items }
    } catch {
      // Names can be typed without suggestions.
    }
  }
}
