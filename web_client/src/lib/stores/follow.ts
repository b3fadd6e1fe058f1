/** Keeps what a page shows up to date by asking again and again. */

const FIRST_PAUSE_MS = 1000
const LONGEST_PAUSE_MS = 5000

/** Runs `work` again and again while the page is visible, until the returned function is called. A hidden page asks nothing.
 *
 * @param work ends when its signal does
 * @param failed gets the reason when it failed
 */
export function keepFollowing(work: (signal: AbortSignal) => Promise<void>, failed: (reason: string) => void): () => void {
  let running = new AbortController()
  let timer: ReturnType<typeof setTimeout> | undefined
  let pause = FIRST_PAUSE_MS

  async function run() {
    const { signal } = (running = new AbortController())
    const began = performance.now()
    try {
      await work(signal)
    } catch (error) {
      if (signal.aborted) return
      failed(error instanceof Error ? error.message : String(error))
    }
    if (signal.aborted) return
    pause = performance.now() - began > LONGEST_PAUSE_MS ? FIRST_PAUSE_MS : Math.min(LONGEST_PAUSE_MS, pause * 2)
    timer = setTimeout(() => void run(), pause)
  }

  function end() {
    running.abort()
    clearTimeout(timer)
  }

  function begin() {
    end()
    if (document.visibilityState === 'hidden') return
    pause = FIRST_PAUSE_MS
    void run()
  }

  begin()
  document.addEventListener('visibilitychange', begin)
  return () => {
    document.removeEventListener('visibilitychange', begin)
    end()
  }
}

/** Runs `work` now, and again `pauseMs` after each run has ended, until the returned function is called.
 *
 * @param work never throws
 */
export function repeat(work: () => Promise<void>, pauseMs: number): () => void {
  let ended = false
  let timer: ReturnType<typeof setTimeout> | undefined

  async function run() {
    await work()
    if (!ended) timer = setTimeout(() => void run(), pauseMs)
  }

  void run()
  return () => {
    ended = true
    clearTimeout(timer)
  }
}
