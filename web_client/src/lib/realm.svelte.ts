/** State of the page of a realm: lists that are asked for in parts, and what is tried. */
import { Refusal } from './api'
import { app } from './app.svelte'
import { administrators, why, type Directory } from './administration'
import { about, gather, groups, Overtaken, users, type Asked, type Part, type RealmAbout } from './realm'

const PART = 100
/** Who types is done when he pauses. */
const PAUSE_MS = 250
/** Names to choose from; others can be typed. */
const KNOWN = 5000

/** Something that is tried, and why it was not done. */
export class Attempt {
  busy = $state(false)
  failure = $state<string | null>(null)

  /** Whether it was done; where it was not, it is told in words, and nothing of what was typed is lost. */
  async run(work: () => Promise<unknown>): Promise<boolean> {
    if (this.busy) return false
    this.busy = true
    this.failure = null
    try {
      await work()
      return true
    } catch (error) {
      this.failure = why(error)
      // What this would stand beside goes.
      if (error instanceof Overtaken && error.gone) app.tell('error', this.failure)
      if (error instanceof Refusal && error.status === 401) app.checkSession()
      return false
    } finally {
      this.busy = false
    }
  }
}

/** A list, as much of it as was asked for, and asked for anew whenever something may have changed. */
export class Listed<T> {
  /** Null before the relay told it. */
  items = $state.raw<T[] | null>(null)
  more = $state(false)
  busy = $state(false)
  failure = $state<string | null>(null)
  private most: number
  private latest = 0
  private timer: ReturnType<typeof setTimeout> | undefined

  /** @param step how many are shown at first, and how many more with each press */
  constructor(
    private readonly ask: (asked: Asked) => Promise<Part<T>>,
    private readonly step = PART,
  ) {
    this.most = step
  }

  /** Asks for it as it is now. */
  async look(): Promise<void> {
    clearTimeout(this.timer)
    const mine = ++this.latest
    this.busy = true
    try {
      const { items, next } = await gather(this.ask, this.most)
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
    await this.look()
  }

  /** Another part is meant: when who types pauses it is asked for from its beginning. */
  filter(): void {
    this.most = this.step
    clearTimeout(this.timer)
    this.timer = setTimeout(() => void this.look(), PAUSE_MS)
  }

  close(): void {
    clearTimeout(this.timer)
    this.latest += 1
  }
}

/** The realm, and who is in it to choose from. */
export class Realm {
  about = $state.raw<RealmAbout | null>(null)
  directory = $state.raw<Directory>({ users: [], groups: [] })
  readonly administrators = $derived(administrators(this.directory))

  /** Something may have changed. */
  async look(): Promise<void> {
    try {
      this.about = await about()
    } catch {
      // The list beside it says why.
    }
  }

  /** Has people and groups to choose from, as they are now. */
  async know(): Promise<void> {
    try {
      const [people, crews] = await Promise.all([gather(users, KNOWN), gather(groups, KNOWN)])
      this.directory = { users: people.items, groups: crews.items }
    } catch {
      // Names can be typed all the same.
    }
  }
}
