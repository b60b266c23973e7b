//! Queries that were run, the newest first. They are kept in the browser; one with a token in it is not.

export interface PastQuery {
  readonly query: string
  /** When it was last run, ms since 1970. */
  readonly at: number
}

const NAME = 'queries'
const MOST = 50
const LONGEST = 20_000
/** As the server makes them. */
const TOKEN = /echolake_[0-9a-f]{8}/i

function stored(): PastQuery[] {
  try {
    const found: unknown = JSON.parse(localStorage.getItem(NAME) ?? '[]')
    if (!Array.isArray(found)) return []
    return found.filter((one) => typeof one?.query === 'string' && typeof one?.at === 'number').slice(0, MOST)
  } catch {
    return []
  }
}

let entries = $state.raw<readonly PastQuery[]>(stored())

function keep(next: readonly PastQuery[]): void {
  entries = next
  try {
    if (next.length) localStorage.setItem(NAME, JSON.stringify(next))
    else localStorage.removeItem(NAME)
  } catch {
    /* storage is refused; the list lasts for this page */
  }
}

export const queryHistory = {
  get entries() {
    return entries
  },
  add(query: string): void {
    if (query.length > LONGEST || TOKEN.test(query)) return
    // Another page of the browser may have added some.
    const others = stored().filter((one) => one.query !== query)
    keep([{ query, at: Date.now() }, ...others].slice(0, MOST))
  },
  clear(): void {
    keep([])
  },
}
