/** Undo and redo of steps that take effect at the relay. */

export interface Step {
  /** For people, such as `connect /scan`. */
  label: string
  do(): Promise<void>
  undo(): Promise<void>
}

/** Steps that can be taken back. */
export const MOST_STEPS = 100

/** A list of steps and a place in it. One step takes effect at a time; a step that fails changes nothing in the list. */
export class History {
  private done: Step[] = []
  private undone: Step[] = []
  private work: Promise<unknown> = Promise.resolve()

  /** @param changed called after each change of the labels */
  constructor(private readonly changed: () => void = () => undefined) {}

  /** Label of the step that undo takes back, or null. */
  get undoLabel(): string | null {
    return this.done.at(-1)?.label ?? null
  }

  get redoLabel(): string | null {
    return this.undone.at(-1)?.label ?? null
  }

  /** Carries out a step. Steps that were taken back can't be repeated any more then. */
  take(step: Step): Promise<void> {
    return this.next(async () => {
      await step.do()
      this.note(step)
    })
  }

  /** Notes a step that has taken effect already. */
  note(step: Step): void {
    this.done = [...this.done, step].slice(-MOST_STEPS)
    this.undone = []
    this.changed()
  }

  undo(): Promise<void> {
    return this.next(async () => {
      const step = this.done.at(-1)
      if (step === undefined) return
      await step.undo()
      this.done.pop()
      this.undone.push(step)
      this.changed()
    })
  }

  redo(): Promise<void> {
    return this.next(async () => {
      const step = this.undone.at(-1)
      if (step === undefined) return
      await step.do()
      this.undone.pop()
      this.done.push(step)
      this.changed()
    })
  }

  private next(work: () => Promise<void>): Promise<void> {
    const mine = this.work.then(work)
    this.work = mine.catch(() => undefined)
    return mine
  }
}
