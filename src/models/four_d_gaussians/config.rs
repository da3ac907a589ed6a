//! Hyperparameters of a 4DGaussians model, from its file `cfg_args`.

use std::path::Path;

use crate::deform::{FieldConfig, Tensors};
use crate::error::Result;
use crate::model::Attributes;
use crate::models::cfg_args::{self, Arguments, SH_DEGREE};

/// Hyperparameters of a 4DGaussians model. Keys that `cfg_args` lacks have the defaults of the original code.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelConfig {
    /// Maximum SH degree of the Gaussians; default 3.
    pub sh_degree: i64,
    /// Path of the folder with the training data.
    pub source_path: Option<String>,
    /// Whether the background of the training images is white rather than black; default false.
    pub white_background: bool,
    /// Width of the deformation network; default 64. The shapes of the tensors take precedence.
    pub net_width: i64,
    /// Number of layers of the trunk, which all heads share; default 1, and 0 means 1. The shapes of the tensors take
    /// precedence.
    pub defor_depth: i64,
    /// For each level of feature planes, the factor on `resolution` along x, y and z; default `[1, 2, 4, 8]`. The
    /// shapes of the tensors take precedence.
    pub multires: Vec<i64>,
    /// Base resolution of the feature planes along x, y, z and t; default `[64, 64, 64, 25]`. Each level multiplies the
    /// resolution along x, y and z by its entry of `multires`; the resolution along t is the same in all levels. The
    /// shapes of the tensors take precedence.
    pub resolution: Vec<i64>,
    /// Number of channels of a feature plane; default 32. The shapes of the tensors take precedence.
    pub channels: i64,
    /// Half the side of the initial box of space that the field covers, scene units; default 1.6. The stored box takes
    /// precedence.
    pub bounds: f64,
    /// Whether the network does not deform positions (has no head for them).
    pub no_dx: bool,
    /// Whether the network does not deform scales (has no head for them).
    pub no_ds: bool,
    /// Whether the network does not deform rotations (has no head for them).
    pub no_dr: bool,
    /// Whether the network does not deform opacities (has no head for them); default true.
    pub no_do: bool,
    /// Whether the network does not deform SH coefficients (has no head for them); default true.
    pub no_dshs: bool,
    /// Whether the network reads position and time (x, y, z, t) instead of features from feature planes.
    pub no_grid: bool,
    /// Whether a network computes for each Gaussian a mask: a factor on its stored parameters.
    pub static_mlp: bool,
    /// Whether a voxel grid provides for each Gaussian a mask: a factor on its stored parameters.
    pub empty_voxel: bool,
    /// Frequency p of an encoding of the features f from the feature planes; default 0, no encoding. If p is above 1,
    /// the network reads f, sin(p·f) and cos(p·f) instead of f alone.
    pub grid_pe: i64,
    /// Whether the field's rotation delta multiplies the stored quaternion instead of being added to it.
    pub apply_rotation: bool,
}

impl ModelConfig {
    /// Reads the `cfg_args` file at `path`.
    ///
    /// # Errors
    /// Fails if the file cannot be read, is no `Namespace(...)`, or a known key has a value of the wrong type.
    pub fn read(path: &Path) -> Result<Self> {
        Self::parse(&cfg_args::read(path)?, path)
    }

    /// Parses the text of a `cfg_args` file; `path` is for error messages.
    ///
    /// Unknown keys may hold any text whose brackets and quotes are balanced.
    pub fn parse(text: &str, path: &Path) -> Result<Self> {
        let arguments = Arguments::parse(text, path)?;
        let get = |name: &'static str| arguments.get(name);
        let planes = get("kplanes_config");
        Ok(ModelConfig {
            sh_degree: get(SH_DEGREE).int(3)?,
            source_path: get("source_path").string()?,
            white_background: get("white_background").bool(false)?,
            net_width: get("net_width").int(64)?,
            defor_depth: get("defor_depth").int(1)?,
            multires: get("multires").ints(&[1, 2, 4, 8])?,
            resolution: planes.entry("resolution")?.ints(&[64, 64, 64, 25])?,
            channels: planes.entry("output_coordinate_dim")?.int(32)?,
            bounds: get("bounds").float(1.6)?,
            no_dx: get("no_dx").bool(false)?,
            no_ds: get("no_ds").bool(false)?,
            no_dr: get("no_dr").bool(false)?,
            no_do: get("no_do").bool(true)?,
            no_dshs: get("no_dshs").bool(true)?,
            no_grid: get("no_grid").bool(false)?,
            static_mlp: get("static_mlp").bool(false)?,
            empty_voxel: get("empty_voxel").bool(false)?,
            grid_pe: get("grid_pe").int(0)?,
            apply_rotation: get("apply_rotation").bool(false)?,
        })
    }

    /// Returns a note for each hyperparameter that contradicts the shapes of the weights `tensors`, which take
    /// precedence.
    pub(super) fn contradicted_by(&self, tensors: &Tensors) -> Vec<String> {
        const TRUNK: &str = "deformation_net.feature_out.";
        const GRIDS: &str = "deformation_net.grid.grids.";
        let side =
            |name: String, axis: usize| -> Option<i64> { tensors.get(&name)?.shape.get(axis).map(|&side| side as i64) };
        let count =
            |name: &dyn Fn(usize) -> String| (0..).take_while(|&k| tensors.contains_key(&name(k))).count() as i64;
        let mut found = vec![
            ("net_width", self.net_width, side(format!("{TRUNK}0.weight"), 0)),
            (
                "defor_depth",
                self.defor_depth.max(1),
                Some(count(&|k| format!("{TRUNK}{}.weight", 2 * k))).filter(|&some| some > 0),
            ),
        ];
        if !self.no_grid {
            let least = |list: &[i64]| list.first().copied().unwrap_or(1);
            let x = self.resolution.first().copied().unwrap_or(0) * least(&self.multires);
            // Planes xy, xz, xt, yz, yt, zt; the first of the two axes is the last dimension of the tensor.
            found.extend([
                (
                    "multires (levels)",
                    self.multires.len() as i64,
                    Some(count(&|k| format!("{GRIDS}{k}.0"))).filter(|&some| some > 0),
                ),
                ("output_coordinate_dim", self.channels, side(format!("{GRIDS}0.0"), 1)),
                ("resolution along x", x, side(format!("{GRIDS}0.0"), 3)),
                ("resolution along t", self.resolution.get(3).copied().unwrap_or(0), side(format!("{GRIDS}0.2"), 2)),
            ]);
        }
        let differs = |(key, configured, actual): (&str, i64, Option<i64>)| {
            let actual = actual.filter(|&actual| actual != configured)?;
            Some(format!(
                "cfg_args says {key} = {configured}, but the weights in deformation.pth have {actual}: the weights \
                 are used"
            ))
        };
        found.into_iter().filter_map(differs).collect()
    }

    /// Returns those hyperparameters that determine how the deformation field is evaluated.
    pub fn field(&self) -> FieldConfig {
        let off = [
            (self.no_dx, Attributes::POSITION),
            (self.no_ds, Attributes::LOG_SCALE),
            (self.no_dr, Attributes::ROTATION),
            (self.no_do, Attributes::OPACITY),
            (self.no_dshs, Attributes::SH),
        ];
        FieldConfig {
            deformed_attributes: off
                .iter()
                .filter(|(off, _)| !off)
                .fold(Attributes::empty(), |set, &(_, column)| set | column),
            static_mlp: self.static_mlp,
            empty_voxel: self.empty_voxel,
            grid_pe: self.grid_pe,
            no_grid: self.no_grid,
            apply_rotation: self.apply_rotation,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::models::cfg_args::{with_sh_degree, without_folder_paths};

    #[test]
    fn archives_keep_no_folder_of_the_training_machine() {
        let text = r#"Namespace(sh_degree=3, source_path='/home/eve/secret/data/', model_path="output\\run 1", images='images/2x',
 extra={'a': ['/home/eve/secret/x', 1]}, posix=PosixPath('/home/eve/it\'s'), w='C:\\secret\\y', eval=True)"#;
        let expected = r#"Namespace(sh_degree=3, source_path='data', model_path="run 1", images='images/2x',
 extra={'a': ['x', 1]}, posix=PosixPath('s'), w='y', eval=True)"#;
        let found = without_folder_paths(text, Path::new("cfg_args")).unwrap();
        assert_eq!(found, expected);
        assert_eq!(without_folder_paths(&found, Path::new("cfg_args")).unwrap(), expected);
        let plain = "Namespace(sh_degree=3, source_path='', eval=True)";
        assert_eq!(without_folder_paths(plain, Path::new("cfg_args")).unwrap(), plain);
    }

    fn parse(text: &str) -> Result<ModelConfig> {
        ModelConfig::parse(text, Path::new("model/cfg_args"))
    }

    fn refusal(text: &str) -> String {
        parse(text).expect_err("must be refused").to_string()
    }

    #[test]
    fn a_namespace_as_the_original_prints_it_is_read() {
        let config = parse(
            "Namespace(sh_degree=2, source_path='data/lego', eval=True, white_background=True, net_width=128, \
             defor_depth=0, bounds=1.6, plane_tv_weight=0.0001, time_smoothness_weight=1e-05, \
             kplanes_config={'grid_dimensions': 2, 'input_coordinate_dim': 4, 'output_coordinate_dim': 16, \
             'resolution': [64, 64, 64, 150]}, multires=[1, 2], no_dx=False, no_do=False, no_dshs=False, \
             static_mlp=True, grid_pe=2, apply_rotation=True)",
        )
        .unwrap();
        assert_eq!(
            config,
            ModelConfig {
                sh_degree: 2,
                source_path: Some("data/lego".into()),
                white_background: true,
                net_width: 128,
                defor_depth: 0,
                multires: vec![1, 2],
                resolution: vec![64, 64, 64, 150],
                channels: 16,
                bounds: 1.6,
                no_dx: false,
                no_ds: false,
                no_dr: false,
                no_do: false,
                no_dshs: false,
                no_grid: false,
                static_mlp: true,
                empty_voxel: false,
                grid_pe: 2,
                apply_rotation: true,
            }
        );
        assert_eq!(config.field().deformed_attributes, Attributes::all());
    }

    #[test]
    fn missing_keys_take_the_defaults_of_the_original() {
        let config = parse("Namespace()").unwrap();
        assert_eq!((config.net_width, config.defor_depth, config.sh_degree), (64, 1, 3));
        assert_eq!(
            config.field().deformed_attributes,
            Attributes::POSITION | Attributes::LOG_SCALE | Attributes::ROTATION
        );
        assert_eq!(config, parse("Namespace(source_path=None, unknown=3)\n").unwrap());
    }

    #[test]
    fn keys_not_needed_may_hold_any_balanced_text() {
        let config = parse(
            "Namespace(a=device(type='cu,d)a', index=0), b=PosixPath('/x'), c=<function f at 0x7f>, d={1, 2}, \
             e=[None, -1.5e-3, (1,), {}], f=np.float64(0.5), g=range(0, 3), h=b'x', i=lambda, net_width=32)",
        )
        .unwrap();
        assert_eq!(config.net_width, 32);
    }

    #[test]
    fn strings_keep_their_escapes() {
        let path = |text: &str| parse(&format!("Namespace(source_path={text})")).unwrap().source_path.unwrap();
        assert_eq!(path(r"'C:\\data\\it\'s'"), r"C:\data\it's");
        assert_eq!(path(r#""it's""#), "it's");
        assert_eq!(path(r"'\x41\u00e9\U0001F600\n'"), "Aé😀\n");
        assert_eq!(path("'данные, (1)'"), "данные, (1)");
    }

    #[test]
    fn another_degree_changes_no_other_byte() {
        for (text, expected) in [
            ("Namespace(sh_degree=3)", "Namespace(sh_degree=1)"),
            (
                "Namespace(a='sh_degree=3, (', b={'sh_degree': 3}, sh_degree = 3 , my_sh_degree=3)\n",
                "Namespace(a='sh_degree=3, (', b={'sh_degree': 3}, sh_degree = 1 , my_sh_degree=3)\n",
            ),
            (" Namespace (net_width=64)", " Namespace (sh_degree=1, net_width=64)"),
            ("Namespace()", "Namespace(sh_degree=1)"),
        ] {
            let found = with_sh_degree(text, 1, Path::new("cfg_args")).unwrap();
            assert_eq!(found, expected);
            assert_eq!(parse(&found).unwrap(), ModelConfig { sh_degree: 1, ..parse(text).unwrap() });
        }
        assert!(with_sh_degree("Namespace(a=", 1, Path::new("cfg_args")).unwrap_err().to_string().contains("byte 12"));
    }

    #[test]
    fn a_value_of_the_wrong_type_is_named() {
        for (text, parts) in [
            ("Namespace(net_width='64')", ["key net_width", "an integer", "the string \"64\""]),
            ("Namespace(no_dx=2)", ["key no_dx", "True or False", "2"]),
            ("Namespace(multires=[1, 'a'])", ["key multires", "an integer", "\"a\""]),
            ("Namespace(kplanes_config=[1])", ["key kplanes_config", "a dictionary", "a list of 1"]),
            ("Namespace(bounds=device(type='cpu'))", ["key bounds", "a number", "device(type='cpu')"]),
        ] {
            let message = refusal(text);
            assert!(parts.iter().all(|part| message.contains(part)), "{text}: {message}");
        }
    }

    #[test]
    fn malformed_text_is_refused_with_its_line_and_byte() {
        for (text, place, expected) in [
            ("", "line 1, byte 0", "Namespace"),
            ("{'a': 1}", "line 1, byte 0", "Namespace"),
            ("Namespace(a=1,\nb=[1, 2", "line 2, byte 22", "closing bracket"),
            ("Namespace(a=1\nb=2)", "line 2, byte 15", "`,` or `)`"),
            ("Namespace(a=)", "byte 12", "a value"),
            ("Namespace(a='x)", "byte 12", "closing quote"),
            ("Namespace(a=1) b", "byte 15", "nothing after"),
            (r"Namespace(a='\xzz')", "byte 13", "escape"),
        ] {
            let message = refusal(text);
            assert!(message.contains(place) && message.contains(expected), "{text:?}: {message}");
        }
    }

    #[test]
    fn nesting_is_bounded() {
        assert!(refusal(&format!("Namespace(a={})", "[".repeat(100_000))).contains("32 levels"));
        // Values that are not interpreted may be nested deeply without using the stack.
        parse(&format!("Namespace(a=f{}{})", "(".repeat(100_000), ")".repeat(100_000))).unwrap();
    }

    #[test]
    fn no_cut_or_changed_byte_panics() {
        let text = r"Namespace(a=-1.5e-3, b={'k': [1, (2,)], 'é': '\x41'}, c=f('x'), no_dx=True)";
        for end in (0..=text.len()).filter(|&end| text.is_char_boundary(end)) {
            let _ = parse(&text[..end]);
            for other in ['\'', '(', ')', '{', ']', ':', ',', '\\', '\0', 'é', '-'] {
                let _ = parse(&format!("{}{other}{}", &text[..end], &text[end..]));
            }
        }
    }
}
