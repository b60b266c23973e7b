//! Queries that were run, the newest first, and those that were saved by a name. They are kept in the browser; one with a
//! token in it is not.
import { mayKeep, readList, writeList } from './stored'

export interface PastQuery {
  readonly query: string
  /** When it was last run, ms since 1970. */
  readonly at: number
}
export interface SavedQuery {
  readonly name: string
  readonly query: string
}

const MOST = 50
const storedPast = () =>
  readList<PastQuery>('queries', (one) => typeof one.query === 'string' && typeof one.at === 'number').slice(0, MOST)
const storedSaved = () =>
  readList<SavedQuery>('saved', (one) => typeof one.query === 'string' && typeof one.name === 'string')

let entries = $state.raw<readonly PastQuery[]>(storedPast())
let saved = $state.raw<readonly SavedQuery[]>(storedSaved())

function keepPast(next: readonly PastQuery[]): void {
  entries = next
  writeList('queries', next)
}
function keepSaved(next: readonly SavedQuery[]): void {
  saved = next
  writeList('saved', next)
}

// Another page of the browser may have added some: each change begins with what is stored.
export const queryHistory = {
  get entries() {
    return entries
  },
  add(query: string): void {
    if (!mayKeep(query)) return
    const others = storedPast().filter((one) => one.query !== query)
    keepPast([{ query, at: Date.now() }, ...others].slice(0, MOST))
  },
  clear(): void {
    keepPast([])
  },
}

export const savedQueries = {
  get entries() {
    return saved
  },
  /** Saves a query; another of the same name is replaced. Returns whether it may be kept. */
  save(name: string, query: string): boolean {
    if (!mayKeep(query)) return false
    const others = storedSaved().filter((one) => one.name !== name)
    keepSaved([...others, { name, query }].sort((a, b) => (a.name < b.name ? -1 : 1)))
    return true
  },
  remove(name: string): void {
    keepSaved(storedSaved().filter((one) => one.name !== name))
  },
}
