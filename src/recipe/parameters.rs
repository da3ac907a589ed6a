//! The list of all parameters, read from the documented preset: what flags and help are made of.

/// One hyper-parameter of the recipe.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Parameter {
    /// Table it stands in: `scan`, `score`, `select`, `merge`, `refine`.
    pub section: String,
    /// Its key, unique over all sections.
    pub key: String,
    /// The comment above it in `paper.toml`, on one line.
    pub doc: String,
}

/// Every parameter of `paper.toml` in file order, merge passes excepted.
pub fn parameters() -> Vec<Parameter> {
    let (mut section, mut doc, mut found) = (String::new(), Vec::new(), Vec::new());
    for line in super::PAPER.lines() {
        if let Some(comment) = line.strip_prefix('#') {
            doc.push(comment.trim());
        } else if let Some(name) = line.strip_prefix('[') {
            section = name.trim_matches(['[', ']']).to_owned();
            doc.clear();
        } else if let Some((key, _)) = line.split_once('=').filter(|_| section != "merge.passes") {
            found.push(Parameter { section: section.clone(), key: key.trim().to_owned(), doc: doc.join(" ") });
            doc.clear();
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_parameter_is_documented_and_has_a_key_of_its_own() {
        let all = parameters();
        let table: toml::Table = toml::from_str(super::super::PAPER).unwrap();
        let leaves: usize =
            table.values().map(|t| t.as_table().unwrap().values().filter(|v| !v.is_array()).count()).sum();
        assert_eq!(all.len(), leaves);
        for (i, parameter) in all.iter().enumerate() {
            assert!(!parameter.doc.is_empty(), "{} has no comment", parameter.key);
            assert!(all[..i].iter().all(|other| other.key != parameter.key), "{} stands twice", parameter.key);
        }
    }
}
