//! Lists that are kept in the browser.

/** As the server makes tokens: what has one is not kept. */
const TOKEN = /echolake_[0-9a-f]{8}/i
const LONGEST = 20_000

/** Whether a query may be kept. */
export const mayKeep = (query: string) => query.length <= LONGEST && !TOKEN.test(query)

/** Reads a list; entries that are not as they should be are left out. */
export function readList<T>(name: string, isEntry: (one: T) => boolean): T[] {
  try {
    const found: unknown = JSON.parse(localStorage.getItem(name) ?? '[]')
    return Array.isArray(found) ? (found as T[]).filter((one) => one && isEntry(one)) : []
  } catch {
    return []
  }
}

export function writeList(name: string, list: readonly unknown[]): void {
  try {
    if (list.length) localStorage.setItem(name, JSON.stringify(list))
    else localStorage.removeItem(name)
  } catch {
    /* storage is refused; the list lasts for this page */
  }
}
