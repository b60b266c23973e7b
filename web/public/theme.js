// Runs before the first paint, so that a chosen theme does not flash.
let theme
try {
  theme = localStorage.getItem('theme')
} catch {
  /* storage is refused; the system's theme holds */
}
const isDark = theme === 'dark' || (theme !== 'light' && matchMedia('(prefers-color-scheme: dark)').matches)
document.documentElement.dataset.theme = isDark ? 'dark' : 'light'
