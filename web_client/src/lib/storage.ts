/** Small choices the browser remembers. Storage may be forbidden; then nothing is remembered. */

export function recall<T>(key: string, fallback: T): T {
  try {
    const text = localStorage.getItem(`switchboard:${key}`)
    return text === null ? fallback : { ...fallback, ...(JSON.parse(text) as Partial<T>) }
  } catch {
    return fallback
  }
}

export function remember(key: string, value: object): void {
  try {
    localStorage.setItem(`switchboard:${key}`, JSON.stringify(value))
  } catch {
    // Private windows and full storage: the choice lasts as long as the page.
  }
}

/** Words for this tab when it is loaded anew. */
export function leave(key: string, words: string): void {
  try {
    sessionStorage.setItem(`switchboard:${key}`, words)
  } catch {
    // Then nothing is said.
  }
}

/** What was left, once. */
export function left(key: string): string | null {
  try {
    const words = sessionStorage.getItem(`switchboard:${key}`)
    sessionStorage.removeItem(`switchboard:${key}`)
    return words
  } catch {
    return null
  }
}
