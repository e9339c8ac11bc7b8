
# -- ours --------------------------------------------------------------------------------------------

_mavftpfs_words='@WORDS@'
_mavftpfs_values='@VALUES@'

_mavftpfs_files() {
  compgen -f -- "$1"
}

_mavftpfs_directories() {
  compgen -d -- "$1"
}

# $1: what is typed of the list behind -o
_mavftpfs_options() {
  local last="${1##*,}"
  local before="${1%"$last"}"
  local word
  case "$last" in
    @FILES@)
      compgen -P "$before${last%%=*}=" -f -- "${last#*=}" ;;
    *=*)
      compgen -P "$before" -W "$_mavftpfs_values" -- "$last" ;;
    *)
      compgen -P "$before" -W "$_mavftpfs_words" -- "$last" ;;
  esac
}

# bash cuts words at colons and equal signs. Here the line is cut at blanks only, and the answers are what
# comes behind the last cut of bash. `SOURCE MOUNTPOINT` without a command is `mount SOURCE MOUNTPOINT`.
_mavftpfs() {
  local line="${COMP_LINE:0:COMP_POINT}"
  local piece="${COMP_WORDS[COMP_CWORD]}"
  local words
  read -ra words <<<"$line"
  [[ "$line" == *[[:blank:]] ]] && words+=("")
  [[ "$piece" == [:=] ]] && piece=""
  local last="${words[${#words[@]}-1]}"
  local known=" ${_shtab_mavftpfs_subparsers[*]} "
  if (( ${#words[@]} > 2 )) && [[ "$known" != *" ${words[1]} "* ]]; then
    words=("${words[0]}" mount "${words[@]:1}")
  fi
  local COMP_WORDS=("${words[@]}")
  local COMP_CWORD=$(( ${#words[@]} - 1 ))
  _shtab_mavftpfs
  if (( COMP_CWORD == 1 )) && [[ "$last" != -* ]]; then
    compopt -o filenames 2>/dev/null
    while IFS= read -r line; do COMPREPLY+=("$line"); done < <(_mavftpfs_files "$last")
  fi
  local cut="" index
  [[ "$last" == *[:=]* && "$last" == *"$piece" ]] && cut="${last%"$piece"}"
  for index in "${!COMPREPLY[@]}"; do
    COMPREPLY[index]="${COMPREPLY[index]#"$cut"}"
    [[ "${COMPREPLY[index]}" == *= ]] && compopt -o nospace 2>/dev/null
  done
  return 0
}

complete -o bashdefault -F _mavftpfs mavftpfs
