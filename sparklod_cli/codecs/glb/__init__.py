"""Binary glTF with the extension KHR_gaussian_splatting."""
