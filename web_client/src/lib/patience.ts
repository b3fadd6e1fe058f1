/** A bounded wait: what it is given to is given up when nothing comes for so long. */
export class Patience {
  private readonly controller = new AbortController()
  private timer: ReturnType<typeof setTimeout> | undefined

  /**
   * @param ms milliseconds; null to wait for ever
   * @param outer gives it up too
   */
  constructor(
    private readonly ms: number | null,
    private readonly outer?: AbortSignal,
  ) {
    if (outer?.aborted) this.giveUp()
    outer?.addEventListener('abort', this.giveUp)
    this.begin()
  }

  get signal(): AbortSignal {
    return this.controller.signal
  }

  /** Something came: the time begins anew. */
  begin(): void {
    clearTimeout(this.timer)
    if (this.ms !== null) this.timer = setTimeout(this.giveUp, this.ms)
  }

  /** It is no longer wanted. */
  end(): void {
    clearTimeout(this.timer)
    this.outer?.removeEventListener('abort', this.giveUp)
  }

  private readonly giveUp = () => this.controller.abort()
}
