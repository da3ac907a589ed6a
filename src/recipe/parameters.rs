//! List of all parameters with their documentation, parsed from the preset `paper`. Command-line flags and help texts
//! are made from this list.

/// Parameter of the recipe, with its documentation.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Parameter {
    /// Name of the recipe table that contains the parameter: `scan`, `score`, `select`, `merge`, `refine`, `field` or
    /// `bands`.
    pub section: String,
    /// Key of the parameter, unique over all tables.
    pub key: String,
    /// Documentation: the comment above the parameter in `paper.toml`, joined to one line.
    pub doc: String,
}

/// Returns every parameter of `paper.toml` in file order, except the parameters of single merge passes.
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
    fn every_parameter_is_documented_and_has_a_unique_key() {
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
