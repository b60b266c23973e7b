//! A table of numbers as LaTeX, CSV or Markdown.

use std::fmt::Write as _;

use crate::canvas::notes::FigureNotes;

/// Colours of the loudest and the quietest value of a column, as on the catalogue's pages: amber and blue, which
/// everybody can tell. The paper has red and green.
const LOUDEST: &str = "[rgb]{0.992,0.89,0.722}";
const QUIETEST: &str = "[rgb]{0.827,0.894,0.961}";

/// The greatest uncertainty that is written as a number.
const MOST_UNCERTAINTY: f64 = 99.0;

/// A row: its name, then a value for each column.
#[derive(Debug, Clone, PartialEq)]
pub struct TableRow {
    /// Its name.
    pub name: String,
    /// A value for each column; none if there is none.
    pub values: Vec<Option<f64>>,
    /// Standard uncertainties of the values; empty if none is known.
    pub uncertainties: Vec<Option<f64>>,
    /// Decimals of its values.
    pub decimals: usize,
    /// The values are per cent.
    pub is_percent: bool,
}

/// A table of numbers.
#[derive(Debug, Clone, PartialEq)]
pub struct FigureTable {
    /// Heading of the names.
    pub corner: String,
    /// Headings of the values.
    pub columns: Vec<String>,
    /// The rows.
    pub rows: Vec<TableRow>,
    /// Colours the extremes of each column.
    pub with_extremes: bool,
}

impl TableRow {
    pub(crate) fn uncertainty(&self, column: usize) -> Option<f64> {
        self.uncertainties.get(column).copied().flatten().filter(|u| u.is_finite())
    }

    // An uncertainty that rounds to nothing is under the last decimal, and not nothing. A band without energy has one
    // beyond all bounds.
    fn cell_text(&self, column: usize, value: Option<f64>) -> String {
        let text = self.value_text(value);
        let Some(u) = self.uncertainty(column) else { return text };
        let least = 10f64.powi(-(self.decimals as i32));
        let digits = self.decimals;
        if u < least / 2.0 {
            return format!("{text} \u{b1} <{least:.digits$}");
        }
        if u > MOST_UNCERTAINTY {
            return format!("{text} \u{b1} >{MOST_UNCERTAINTY}");
        }
        format!("{text} \u{b1} {u:.digits$}")
    }

    fn value_text(&self, value: Option<f64>) -> String {
        let Some(value) = value.filter(|value| value.is_finite()) else { return "\u{2013}".into() };
        let text = format!("{value:.*}", self.decimals);
        // No minus before what is rounded to nothing.
        let is_zero = text.bytes().all(|b| matches!(b, b'-' | b'0' | b'.'));
        let text = if is_zero { text.trim_start_matches('-').to_owned() } else { text };
        format!("{text}{}", if self.is_percent { " %" } else { "" })
    }
}

impl FigureTable {
    /// Returns the lowest and the highest value of a column, if they differ as they are written.
    fn column_extremes(&self, column: usize) -> Option<[f64; 2]> {
        let values = || self.rows.iter().filter_map(|row| row.values.get(column)?.filter(|value| value.is_finite()));
        let low = values().fold(f64::MAX, f64::min);
        let high = values().fold(f64::MIN, f64::max);
        (self.with_extremes && high - low >= 0.005).then_some([low, high])
    }

    /// Returns the table as LaTeX; the colours of extremes need the packages `colortbl` and `xcolor`.
    pub fn to_latex(&self, notes: &FigureNotes) -> String {
        let mut out = comment_lines(notes, "% ");
        let columns = "c".repeat(self.columns.len());
        let heads: Vec<_> = self.columns.iter().map(|name| latex_text(name)).collect();
        let _ = writeln!(out, "\\begin{{tabular}}{{l{columns}}}\n\\hline");
        let _ = writeln!(out, "{} & {} \\\\\n\\hline\\hline", latex_text(&self.corner), heads.join(" & "));
        for row in &self.rows {
            let cells = row.values.iter().enumerate().map(|(column, value)| {
                let text = latex_text(&row.cell_text(column, *value).replace('-', "\u{2212}"));
                match (self.column_extremes(column), value) {
                    (Some([low, _]), Some(value)) if low == *value => format!("{{\\cellcolor{QUIETEST}}}{text}"),
                    (Some([_, high]), Some(value)) if high == *value => format!("{{\\cellcolor{LOUDEST}}}{text}"),
                    _ => text,
                }
            });
            let cells: Vec<_> = cells.collect();
            let _ = writeln!(out, "\\emph{{{}}} & {} \\\\", latex_text(&row.name), cells.join(" & "));
        }
        out.push_str("\\hline\n\\end{tabular}\n");
        out
    }

    /// Returns the table as CSV, its notes in lines that begin with `#`. Values are not rounded. Standard uncertainties
    /// have columns of their own behind those of the values.
    pub fn to_csv(&self, notes: &FigureNotes) -> String {
        let mut out = comment_lines(notes, "# ");
        let has_uncertainties = self.rows.iter().any(|row| !row.uncertainties.is_empty());
        let of_uncertainty = |name: &String| format!("standard uncertainty of {name}");
        let uncertain = self.columns.iter().filter(|_| has_uncertainties).map(of_uncertainty);
        let heads = [self.corner.clone()].into_iter().chain(self.columns.iter().cloned()).chain(uncertain);
        let heads: Vec<_> = heads.map(|name| csv_text(&name)).collect();
        let _ = writeln!(out, "{}", heads.join(","));
        for row in &self.rows {
            let values = row.values.iter().map(|value| value.filter(|value| value.is_finite()));
            let uncertain = (0..self.columns.len()).filter(|_| has_uncertainties).map(|i| row.uncertainty(i));
            let numbers = values.chain(uncertain).map(|value| value.map_or_else(String::new, |v| v.to_string()));
            let name = if row.is_percent { format!("{}, %", row.name) } else { row.name.clone() };
            let cells: Vec<_> = [csv_text(&name)].into_iter().chain(numbers).collect();
            let _ = writeln!(out, "{}", cells.join(","));
        }
        out
    }

    /// Returns the table as Markdown, its notes in a comment; extremes are bold (highest) and italic (lowest).
    pub fn to_markdown(&self, notes: &FigureNotes) -> String {
        let notes = comment_lines(notes, "").replace("-->", "-- >");
        let mut out = if notes.is_empty() { notes } else { format!("<!--\n{notes}-->\n\n") };
        let _ = writeln!(out, "| {} | {} |", markdown_text(&self.corner), self.columns.join(" | "));
        let _ = writeln!(out, "| --- |{}", " ---: |".repeat(self.columns.len()));
        for row in &self.rows {
            let cells = row.values.iter().enumerate().map(|(column, value)| {
                let text = row.cell_text(column, *value).replace('-', "\u{2212}");
                match (self.column_extremes(column), value) {
                    (Some([low, _]), Some(value)) if low == *value => format!("*{text}*"),
                    (Some([_, high]), Some(value)) if high == *value => format!("**{text}**"),
                    _ => text,
                }
            });
            let _ = writeln!(out, "| {} | {} |", markdown_text(&row.name), cells.collect::<Vec<_>>().join(" | "));
        }
        out
    }
}

fn comment_lines(notes: &FigureNotes, mark: &str) -> String {
    let line = |(name, text): (&str, String)| format!("{mark}{name}: {}\n", text.replace(['\n', '\r'], " "));
    notes.named_notes().into_iter().map(line).collect()
}

fn latex_text(text: &str) -> String {
    let mut out = String::new();
    for character in text.chars() {
        match character {
            '_' | '%' | '&' | '#' | '$' | '{' | '}' => out.extend(['\\', character]),
            '<' => out.push_str("\\textless{}"),
            '>' => out.push_str("\\textgreater{}"),
            '|' => out.push_str("\\textbar{}"),
            '\\' => out.push_str("\\textbackslash{}"),
            '~' => out.push_str("\\textasciitilde{}"),
            '^' => out.push_str("\\textasciicircum{}"),
            '\u{2013}' => out.push_str("--"),
            '\u{2212}' => out.push_str("$-$"),
            '\u{b1}' => out.push_str("$\\pm$"),
            other => out.push(other),
        }
    }
    out
}

fn csv_text(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) { format!("\"{}\"", text.replace('"', "\"\"")) } else { text.to_owned() }
}

fn markdown_text(text: &str) -> String {
    text.replace('|', "\\|").replace('_', "\\_")
}

#[cfg(test)]
mod tests {
    use expect_test::expect;

    use super::*;

    fn table() -> FigureTable {
        let row = |name: &str, values: [Option<f64>; 2]| TableRow {
            name: name.into(),
            values: values.to_vec(),
            uncertainties: Vec::new(),
            decimals: 2,
            is_percent: false,
        };
        let rows = vec![row("0015_1", [Some(-7.66), Some(-0.001)]), row("0012_1", [Some(-7.8), None])];
        let columns = vec!["2.5 kHz".into(), "Total".into()];
        FigureTable { corner: "Panel".into(), columns, rows, with_extremes: true }
    }

    #[test]
    fn a_table_is_latex_with_its_notes() {
        let notes = FigureNotes { query: "select 1\nfrom x".into(), lake: "7".into(), ..FigureNotes::default() };
        expect![[r#"
            % Query: select 1 from x
            % Lake: 7
            \begin{tabular}{lcc}
            \hline
            Panel & 2.5 kHz & Total \\
            \hline\hline
            \emph{0015\_1} & {\cellcolor[rgb]{0.992,0.89,0.722}}$-$7.66 & 0.00 \\
            \emph{0012\_1} & {\cellcolor[rgb]{0.827,0.894,0.961}}$-$7.80 & -- \\
            \hline
            \end{tabular}
        "#]]
        .assert_eq(&table().to_latex(&notes));
    }

    #[test]
    fn a_table_is_csv_and_markdown() {
        expect![[r#"
            Panel,2.5 kHz,Total
            0015_1,-7.66,-0.001
            0012_1,-7.8,
        "#]]
        .assert_eq(&table().to_csv(&FigureNotes::default()));
        expect![[r#"
            | Panel | 2.5 kHz | Total |
            | --- | ---: | ---: |
            | 0015\_1 | **−7.66** | 0.00 |
            | 0012\_1 | *−7.80* | – |
        "#]]
        .assert_eq(&table().to_markdown(&FigureNotes::default()));
    }

    #[test]
    fn uncertainties_are_beside_their_values() {
        let mut table = table();
        table.rows[0].uncertainties = vec![Some(0.0123), Some(0.004)];
        table.rows[1].uncertainties = vec![Some(1.2e31)];
        let markdown = table.to_markdown(&FigureNotes::default());
        assert!(markdown.contains("| **−7.66 ± 0.01** | 0.00 ± <0.01 |") && markdown.contains("| *−7.80 ± >99* |"));
        table.rows[1].uncertainties.clear();
        assert!(table.to_latex(&FigureNotes::default()).contains("$-$7.66 $\\pm$ 0.01 & 0.00 $\\pm$ \\textless{}0.01"));
        expect![[r#"
            Panel,2.5 kHz,Total,standard uncertainty of 2.5 kHz,standard uncertainty of Total
            0015_1,-7.66,-0.001,0.0123,0.004
            0012_1,-7.8,,,
        "#]]
        .assert_eq(&table.to_csv(&FigureNotes::default()));
    }

    #[test]
    fn notes_stay_in_their_comment() {
        let notes = FigureNotes { title: "a --> b".into(), ..FigureNotes::default() };
        assert!(table().to_markdown(&notes).starts_with("<!--\nTitle: a -- > b\n-->\n\n| Panel |"));
        let notes = FigureNotes { title: "a\r\n\\input{b}".into(), ..FigureNotes::default() };
        assert!(table().to_latex(&notes).starts_with("% Title: a  \\input{b}\n\\begin"));
    }

    #[test]
    fn what_is_no_number_is_a_dash() {
        let mut table = table();
        table.rows[1].values = vec![Some(f64::NAN), Some(f64::NEG_INFINITY)];
        assert!(table.to_latex(&FigureNotes::default()).contains("\\emph{0012\\_1} & -- & -- \\\\"));
        assert!(table.to_csv(&FigureNotes::default()).ends_with("0012_1,,\n"));
        assert_eq!(
            latex_text("a_b & <c> 5 % ~^"),
            "a\\_b \\& \\textless{}c\\textgreater{} 5 \\% \\textasciitilde{}\\textasciicircum{}"
        );
    }
}
