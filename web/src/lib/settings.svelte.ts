//! What a reader prefers: theme and colours. Kept in the browser, not in the address.

import { flushSync } from 'svelte'

export type Theme = 'system' | 'light' | 'dark'
/** Colours of grid plots: centred on 0 dB with a range that fits, or those of the paper. */
export type Palette = 'fitted' | 'paper'

function stored<T extends string>(name: string, allowed: readonly T[], fallback: T): T {
  try {
    const value = localStorage.getItem(name) as T | null
    return value && allowed.includes(value) ? value : fallback
  } catch {
    return fallback
  }
}

function storedText(name: string): string {
  try {
    return localStorage.getItem(name) ?? ''
  } catch {
    return ''
  }
}

function store(name: string, value: string): void {
  try {
    localStorage.setItem(name, value)
  } catch {
    /* storage is refused; the choice lasts for this page */
  }
}

const dark = matchMedia('(prefers-color-scheme: dark)')
let theme = $state<Theme>(stored('theme', ['system', 'light', 'dark'], 'system'))
let palette = $state<Palette>(stored('palette', ['fitted', 'paper'], 'fitted'))
let lichtblick = $state(storedText('lichtblick'))
let systemDark = $state(dark.matches)
let isPrinting = $state(false)
/** Paper is light. */
const isDark = () => !isPrinting && (theme === 'dark' || (theme === 'system' && systemDark))
function showTheme(): void {
  document.documentElement.dataset.theme = isDark() ? 'dark' : 'light'
}
dark.addEventListener('change', () => {
  systemDark = dark.matches
  showTheme()
})

/** What draws on a canvas draws again before the page is printed. */
const setPrinting = (value: boolean) => {
  flushSync(() => {
    isPrinting = value
    showTheme()
  })
}
addEventListener('beforeprint', () => setPrinting(true))
addEventListener('afterprint', () => setPrinting(false))

export const settings = {
  get theme() {
    return theme
  },
  set theme(value: Theme) {
    theme = value
    store('theme', value)
    showTheme()
  },
  get palette() {
    return palette
  },
  set palette(value: Palette) {
    palette = value
    store('palette', value)
  },
  /** Where the reader's Lichtblick answers; empty if there is none. */
  get lichtblick() {
    return lichtblick
  },
  set lichtblick(value: string) {
    lichtblick = value
    store('lichtblick', value)
  },
  get isPrinting() {
    return isPrinting
  },
  get isDark() {
    return isDark()
  },
}
