/** Choices that the browser stores. If storage is forbidden, nothing is stored. */

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
    // In a private window, or with full storage, the choice lasts as long as the page.
  }
}

/** Message for this tab after a reload. */
export function leave(key: string, words: string): void {
  try {
    sessionStorage.setItem(`switchboard:${key}`, words)
  } catch {
    // Then the message is not shown.
  }
}

/** Returns the message, and removes it. */
export function left(key: string): string | null {
  try {
    const words = sessionStorage.getItem(`switchboard:${key}`)
    sessionStorage.removeItem(`switchboard:${key}`)
    return words
  } catch {
    return null
  }
}
