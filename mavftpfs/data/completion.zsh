# -- ours --------------------------------------------------------------------------------------------

_mavftpfs_options() {
  _values -s , 'mount option' \
@VALUES@
}

# `SOURCE MOUNTPOINT` without a command is `mount SOURCE MOUNTPOINT`.
_mavftpfs_command() {
  local -a commands=(@COMMANDS@)
  local first=$(( CURRENT == 2 ))
  if (( CURRENT > 2 )) && [[ -z "${commands[(r)${words[2]}]}" ]]; then
    words=("${words[1]}" mount "${(@)words[2,-1]}")
    (( CURRENT += 1 ))
  fi
  _shtab_mavftpfs "$@"
  (( first )) && _files
}

