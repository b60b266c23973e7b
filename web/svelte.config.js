//! Svelte's settings: styles go into files, so that the page needs no inline ones.
export default { compilerOptions: { css: 'external', runes: true } }
