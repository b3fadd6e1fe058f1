/** An abort signal that fires when no data has come for some time. */
export class ReceiveTimeout {
  private readonly controller = new AbortController()
  private timer: ReturnType<typeof setTimeout> | undefined

  /**
   * @param ms milliseconds; null to wait for ever
   * @param outer aborts it too
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

  /** Data was received: restarts the timeout. */
  begin(): void {
    clearTimeout(this.timer)
    if (this.ms !== null) this.timer = setTimeout(this.giveUp, this.ms)
  }

  /** Ends the timeout. */
  end(): void {
    clearTimeout(this.timer)
    this.outer?.removeEventListener('abort', this.giveUp)
  }

  private readonly giveUp = () => this.controller.abort()
}
